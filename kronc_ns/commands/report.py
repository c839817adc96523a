"""`kronc report`."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class Report:
    """Write report.html: cameras before and after, keypoints over images, residuals, every view; in a single file."""

    data: Path
    """Folder that `kronc solve` or `ns-process-data kronc` wrote; gets report.html."""

    def run(self) -> int:
        """Write the report."""
        from kronc_ns.show.report import write_report

        print(write_report(self.data))
        return 0
