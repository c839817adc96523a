"""`kronc view`."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class View:
    """See solved cameras and keypoints in 3D in the browser: images, rays, before and after, every view's residuals."""

    data: Path
    """Folder that `kronc solve` or `ns-process-data kronc` wrote."""
    port: int = 8080
    """Where the browser finds it: http://localhost:PORT, on this machine only."""

    def run(self) -> int:
        """Serve until Ctrl-C."""
        from kronc_ns.show.viewer import view

        view(self.data, self.port)
        return 0
