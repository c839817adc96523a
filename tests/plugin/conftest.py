"""What all tests of the plugin share: one thread for torch, and a cache that is not the user's."""

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="package", autouse=True)
def _one_thread() -> Iterator[None]:
    """Tiny tensors on a busy machine: threads only wait for each other."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="package", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory, compiled_solver: None) -> Iterator[None]:
    """One cache for all tests, for the commands that they start, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KRONC_NS_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def without_lpips() -> Iterator[None]:
    """No LPIPS, which takes longest to build and whose weights may be missing."""
    import kronc_ns.plugin.methods  # noqa: F401 - replaces LPIPS itself when first imported, and for good
    from kronc_ns.plugin.compatibility import UnavailableLpips

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", lambda **_: UnavailableLpips())
        yield
