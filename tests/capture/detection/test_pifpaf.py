"""OpenPifPaf as a child process, played by a small program that takes the same arguments."""

import json
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from kronc_ns.capture.detection import environment
from kronc_ns.capture.detection.choice import DetectorOptions
from kronc_ns.capture.detection.detector import CarImage, Detector
from kronc_ns.capture.detection.environment import find_environment
from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.capture.detection.pifpaf import OpenPifPafDetector
from kronc_ns.commands.convert_detector import ConvertDetector
from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import APOLLOCAR3D_24, APOLLOCAR3D_66
from tests.capture.detection.dots import composite_net, draw, save

PRELUDE = """#!{python}
import json, os, sys, time
from pathlib import Path
arguments = sys.argv[1:]
images = [a for a in arguments if a.endswith((".png", ".jpg"))]
found = Path("found")
def car(shift, count=66):
    rows = [v for j in range(count) for v in ((10.0 + j + shift, 20.0, 0.5) if j % 2 else (0.0, 0.0, 0.0))]
    return {{"keypoints": rows, "bbox": [0, 0, 1, 1], "score": 0.7, "category_id": 1}}
def write(image, cars):
    (found / (image + ".predictions.json")).write_text(json.dumps(cars))
Path({log!r}).open("a").write(json.dumps(arguments) + "\\n")
"""


@pytest.fixture
def fake(tmp_path: Path):
    """Makes a program of this body and returns its path; its calls are logged beside it."""

    def make(body: str, name: str = "python") -> Path:
        program = tmp_path / "bin" / name
        program.parent.mkdir(exist_ok=True)
        program.write_text(PRELUDE.format(python=sys.executable, log=str(tmp_path / "calls")) + body)
        program.chmod(program.stat().st_mode | stat.S_IEXEC)
        return program

    return make


def calls(tmp_path: Path) -> list[list[str]]:
    return [json.loads(line) for line in (tmp_path / "calls").read_text().splitlines()]


def photos(folder: Path, names: tuple[str, ...] = ("a.png", "b.png", "c.png")) -> list[CarImage]:
    return [CarImage(save(folder / name, draw(np.zeros((0, 5, 2)), (30, 20)))) for name in names]


def test_cars_come_in_the_order_of_the_images(tmp_path: Path, fake):
    program = fake("for i, image in enumerate(images):\n    write(image, [car(i + 100 * k) for k in range(i)])\n")
    detector: Detector = OpenPifPafDetector(None, program)
    answers = list(detector.detect(photos(tmp_path)))
    assert [len(cars) for cars in answers] == [0, 1, 2]
    first, second = answers[2]
    assert detector.schema is APOLLOCAR3D_66
    assert first.uv[1].tolist() == [13.5, 20.5]  # OpenPifPaf counts from the centre of the first pixel
    assert second.uv[1].tolist() == [113.5, 20.5]
    assert first.confidence[:2].tolist() == [0.0, 0.5]
    assert first.bbox.tolist() == [13.5, 20.5, 77.5, 20.5]
    assert first.score == 0.7
    (arguments,) = calls(tmp_path)
    expected = ["-m", "openpifpaf.predict", "--checkpoint", "shufflenetv2k16-apollo-66", "--json-output", "found"]
    expected += ["--instance-threshold", "0.05", "--seed-threshold", "0.05"]
    assert arguments == [*expected, "000000.png", "000001.png", "000002.png"]


def test_names_may_be_anything(tmp_path: Path, fake):
    body = "for image in images:\n    assert Path(image).read_bytes()[1:4] == b'PNG'\n    write(image, [car(0)])\n"
    names = ("Größe 車 1.png", "-x.png", "sub/same.png", "other/same.png", 'it\'s "q" $HOME.png')
    detector = OpenPifPafDetector(None, fake(body))
    assert [len(cars) for cars in detector.detect(photos(tmp_path / "größe", names))] == [1] * 5


def test_transparent_pixels_are_offered_as_white(tmp_path: Path, fake):
    rgba = np.zeros((20, 30, 4), dtype=np.uint8)
    body = "from PIL import Image\nassert Image.open(images[0]).getpixel((0, 0)) == (255, 255, 255)\n"
    body += "write(images[0], [])\n"
    assert list(OpenPifPafDetector(None, fake(body)).detect([CarImage(save(tmp_path / "a.png", rgba))])) == [[]]


def test_large_frames_are_scaled_down(tmp_path: Path, fake):
    image = save(tmp_path / "large.jpg", np.zeros((1200, 2400, 3), dtype=np.uint8))
    list(OpenPifPafDetector(None, fake("write(images[0], [])\n")).detect([CarImage(image)]))
    assert "--long-edge 1920" in " ".join(calls(tmp_path)[0])


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            "print('Traceback');print('RuntimeError: the reason');sys.exit(1)\n",
            "OpenPifPaf stopped: RuntimeError: the reason",
        ),
        ("sys.exit(1)\n", "OpenPifPaf stopped: exit status 1"),
        ("write(images[0], [car(0)])\nprint('done')\n", "OpenPifPaf stopped: done"),
        ("(found / (images[0] + '.predictions.json')).write_text('[{')\n", "OpenPifPaf stopped: exit status 0"),
        ("write(images[0], {})\n", "expected a list of instances"),
        ("write(images[0], [car(0, 24)])\n", "finds 24 points, not the 66 of apollocar3d-66"),
        (
            "print('Downloading: \"http://host/x.pkl\" to /home/u/checkpoints/x.pkl')\n"
            "print('Traceback (most recent call last):')\n"
            "print('urllib.error.URLError: <urlopen error [Errno -2] Name or service not known>')\nsys.exit(1)\n",
            r"weights are missing and http://host/x\.pkl cannot be had .*put it at /home/u/checkpoints/x\.pkl",
        ),
        (
            "print('error: Request failed after 3 retries')\nprint('  cause: dns error')\nsys.exit(2)\n",
            r"uvx cannot build OpenPifPaf's environment \(cause: dns error\).*--detector-python",
        ),
        (
            "print('/usr/bin/python: No module named openpifpaf')\nsys.exit(1)\n",
            "--detector-python has no openpifpaf",
        ),
    ],
)
def test_what_the_child_says_becomes_one_line(tmp_path: Path, fake, body: str, message: str):
    with pytest.raises(KroncError, match=message) as caught:
        list(OpenPifPafDetector(None, fake(body)).detect(photos(tmp_path)))
    assert "\n" not in str(caught.value)


def test_a_slow_child_is_followed_and_ends_with_us(tmp_path: Path, fake):
    body = (
        "half = found / (images[0] + '.predictions.json')\nhalf.write_text('[{\"keypoints\": [')\ntime.sleep(0.5)\n"
        f"write(images[0], [car(0)])\nPath({str(tmp_path / 'pid')!r}).write_text(str(os.getpid()))\ntime.sleep(600)\n"
    )
    start = time.monotonic()
    answers = OpenPifPafDetector(None, fake(body)).detect(photos(tmp_path))
    assert len(next(answers)) == 1
    while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
        time.sleep(0.01)
    answers.close()
    assert time.monotonic() - start < 60
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_checkpoints_by_name_and_by_file(tmp_path: Path, fake, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    program = fake("write(images[0], [car(0, 24)])\n")
    small = OpenPifPafDetector(Path("shufflenetv2k16-apollo-24"), program)
    assert small.schema is APOLLOCAR3D_24
    ((car,),) = small.detect(photos(tmp_path, ("a.png",)))
    assert len(car.uv) == 24
    with pytest.raises(KroncError, match=r"checkpoint nowhere\.pkl does not exist"):
        OpenPifPafDetector(Path("nowhere.pkl"), program)
    own = tmp_path / "own.pkl"
    own.write_bytes(b"1")
    first = OpenPifPafDetector(own, program).identity
    own.write_bytes(b"2")
    assert OpenPifPafDetector(own, program).identity != first
    schema = {"name": "doors", "keypoints": [f"d{j}" for j in range(24)], "flip": []}
    own.with_suffix(".json").write_text(json.dumps({"schema": schema}))
    detector = OpenPifPafDetector(own, program)
    assert detector.schema.name == "doors"
    assert len(list(detector.detect(photos(tmp_path, ("a.png",))))) == 1
    assert str(own) in calls(tmp_path)[-1]


def test_uvx_makes_the_environment(tmp_path: Path, fake, monkeypatch: pytest.MonkeyPatch):
    program = fake("write(images[0], [])\n", name="uvx")
    monkeypatch.setenv("PATH", str(program.parent))
    list(OpenPifPafDetector(None, None).detect(photos(tmp_path, ("a.png",))))
    arguments = calls(tmp_path)[0]
    constraints = arguments.pop(arguments.index("--build-constraints") + 1)
    assert Path(constraints).read_text().split() == ["setuptools<70"]
    expected = (
        "--python 3.10 --build-constraints --with numpy<2 --from openpifpaf==0.13.11 python -m openpifpaf.predict"
    )
    assert " ".join(arguments).startswith(expected)


def test_without_uvx_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(environment.sys, "executable", str(tmp_path / "python"))
    with pytest.raises(KroncError, match=r"pip install 'kronc-ns\[openpifpaf\]'"):
        find_environment(None)
    with pytest.raises(KroncError, match="--detector-python nowhere is no program"):
        find_environment(Path("nowhere"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"detector": "onnx"}, "--detector onnx needs --detector-weights"),
        ({"detector_weights": Path("x.onnx")}, "give that too"),
        ({"detector": "simcc", "detector_weights": Path("nowhere.onnx")}, r"nowhere\.onnx does not exist"),
    ],
)
def test_options_that_do_not_fit_are_named(options: dict, message: str):
    with pytest.raises(KroncError, match=message):
        DetectorOptions(**options).make()
    assert DetectorOptions().make() is None


def converter(tmp_path: Path, fake) -> dict:
    """Options of a conversion whose OpenPifPaf copies a ready network."""
    net = composite_net(tmp_path / "ready.onnx")
    checkpoint = {"name": "own.pkl", "sha256": "ab" * 32}
    card = {"keypoints": ["a", "b", "c", "d", "e"], "stride": 8, "checkpoint": checkpoint}
    body = f"import shutil\nassert arguments[0].endswith('export_fields.py')\nshutil.copy({str(net)!r}, arguments[2])\n"
    program = fake(body + f"Path(arguments[3]).write_text({json.dumps(card)!r})\n")
    (tmp_path / "own.pkl").write_bytes(b"weights")
    return {"checkpoint": tmp_path / "own.pkl", "output": tmp_path / "net.onnx", "detector_python": program}


def test_a_converted_detector_is_ready_to_run(tmp_path: Path, fake, capsys: pytest.CaptureFixture[str]):
    options = converter(tmp_path, fake)
    assert ConvertDetector(**options, sha256="AB" * 32).run() == 0
    assert "5 points" in capsys.readouterr().out
    card = json.loads((tmp_path / "net.json").read_text())
    assert card["sha256"] == file_sha256(tmp_path / "net.onnx")
    assert card["checkpoint"] == {"name": "own.pkl", "sha256": "ab" * 32}
    detector = DetectorOptions("onnx", tmp_path / "net.onnx").make()
    assert detector is not None
    assert detector.schema.keypoints == ("a", "b", "c", "d", "e")
    uv = np.array([[60.4, 50.0], [250.3, 61.8], [111.7, 180.2], [180.5, 99.5], [270.1, 190.9]])
    ((car,),) = detector.detect([CarImage(save(tmp_path / "p.png", draw(uv, (317, 241))))])
    np.testing.assert_allclose(car.uv, uv, atol=0.1)
    with pytest.raises(KroncError, match=r"net\.onnx exists already: give another --output"):
        ConvertDetector(**options).run()


def test_a_conversion_that_fails_leaves_nothing(tmp_path: Path, fake):
    options = converter(tmp_path, fake)
    with pytest.raises(KroncError, match=r"own\.pkl has sha256 abab.*not --sha256 cd"):
        ConvertDetector(**options, sha256="cd" * 32).run()
    options["detector_python"] = fake("sys.exit('own.pkl has 0 heads')\n")
    with pytest.raises(KroncError, match=r"OpenPifPaf stopped: own\.pkl has 0 heads"):
        ConvertDetector(**options).run()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bin", "calls", "own.pkl", "ready.onnx"]
    with pytest.raises(KroncError, match=r"expected a name that ends in \.onnx"):
        ConvertDetector(**{**options, "output": tmp_path / "net"}).run()


TERMINATED = """
import signal
import sys
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background jobs ignore
from kronc_ns.capture.detection.detector import CarImage
from kronc_ns.capture.detection.pifpaf import OpenPifPafDetector
from kronc_ns.commands.console import exit_on_error
with exit_on_error():
    list(OpenPifPafDetector(None, Path(sys.argv[1])).detect([CarImage(Path(sys.argv[2]))]))
"""


@pytest.mark.parametrize(("sent", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_child_ends_when_we_are_told_to(tmp_path: Path, fake, sent: signal.Signals, status: int):
    pid = tmp_path / "pid"
    program = fake(f"Path({str(pid)!r}).write_text(str(os.getpid()))\ntime.sleep(600)\n")
    (image,) = photos(tmp_path, ("a.png",))
    command = [sys.executable, "-c", TERMINATED, str(program), str(image.path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as parent:
        while not (pid.exists() and pid.read_text()):
            assert parent.poll() is None
            time.sleep(0.01)
        parent.send_signal(sent)
        try:
            _, said = parent.communicate(timeout=60)
        finally:
            parent.kill()
    assert parent.returncode == status
    assert len(said.splitlines()) == 1
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)
