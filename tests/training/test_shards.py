import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.training.shards import Picture, Pictures, write_shard


def _picture(rng: np.random.Generator) -> Picture:
    smooth = np.linspace(0, 200, 480)[None, :, None] + rng.uniform(0, 50, (1, 1, 3)) + np.zeros((352, 1, 1))
    mask = np.where(rng.uniform(size=(352, 480)) > 0.5, 255, 0).astype(np.uint8)
    return Picture(smooth.astype(np.uint8), mask, rng.uniform(0, 300, (66, 3)), f"car {rng.integers(9)}")


def test_pictures_come_back_from_several_shards(tmp_path):
    rng = np.random.default_rng(0)
    made = [_picture(rng) for _ in range(5)]
    write_shard(tmp_path / "0.npz", made[:2])
    write_shard(tmp_path / "1.npz", made[2:])
    read = Pictures([tmp_path / "0.npz", tmp_path / "1.npz"])
    assert len(read) == 5
    for picture, again in zip(made, read, strict=True):
        np.testing.assert_array_equal(again.mask, picture.mask)
        np.testing.assert_allclose(again.keypoints, picture.keypoints, atol=1e-4)
        assert np.abs(again.rgb.astype(float) - picture.rgb).mean() < 2
        assert again.body == picture.body


def test_no_shards_are_an_error():
    with pytest.raises(KroncError, match="render some first"):
        Pictures([])
