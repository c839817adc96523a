"""`--detector openpifpaf`: OpenPifPaf's own command on many images at a time."""

from collections.abc import Generator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from kronc_ns.capture.detection.detector import CarDetection, CarImage, bounds
from kronc_ns.capture.detection.environment import VERSION, Environment, find_environment
from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.capture.detection.pixels import MAX_LONG_SIDE, is_transparent, read_rgb
from kronc_ns.capture.images import upright_size
from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import openpifpaf_rows, read_predictions, read_schema
from kronc_ns.files.output import read_json
from kronc_ns.keypoints.schema import APOLLOCAR3D_24, APOLLOCAR3D_66, KeypointSchema

CHECKPOINT = "shufflenetv2k16-apollo-66"
_THRESHOLD = 0.05  # of instances and their seeds: the solver knows what to do with doubtful points


class OpenPifPafDetector:
    """All cars in an image, each with its points."""

    uses_masks = False

    def __init__(self, checkpoint: Path | None, python: Path | None) -> None:
        self._environment: Environment = find_environment(python)
        self._checkpoint, self._content, self.schema = find_checkpoint(checkpoint)

    @property
    def identity(self) -> str:
        """Checkpoint and options."""
        return f"openpifpaf {VERSION} {self._content} {_THRESHOLD} {MAX_LONG_SIDE}"

    def detect(self, images: Sequence[CarImage]) -> Generator[list[CarDetection], None, None]:
        """The cars in each image, as the child writes them."""
        with TemporaryDirectory(prefix="kronc-openpifpaf-") as temporary:
            folder = Path(temporary)
            names = [_offer(image.path, folder, number) for number, image in enumerate(images)]
            (folder / "found").mkdir()  # without it, every image would overwrite one file of this name
            with self._environment.run([*self._arguments(images), *names], folder) as child:
                for name in names:
                    file = folder / "found" / f"{name}.predictions.json"
                    child.wait_for_json(file)
                    yield self._cars(file)

    def _arguments(self, images: Sequence[CarImage]) -> list[str]:
        arguments = ["-m", "openpifpaf.predict", "--checkpoint", self._checkpoint, "--json-output", "found"]
        arguments += ["--instance-threshold", str(_THRESHOLD), "--seed-threshold", str(_THRESHOLD)]
        if max(max(upright_size(image.path)) for image in images) > MAX_LONG_SIDE:
            arguments += ["--long-edge", str(MAX_LONG_SIDE)]
        return arguments

    def _cars(self, file: Path) -> list[CarDetection]:
        instances = read_predictions(file)
        counts = {len(instance["keypoints"]) // 3 for instance in instances} - {len(self.schema)}
        if counts:
            raise KroncError(
                f"{self._checkpoint} finds {counts.pop()} points, not the {len(self.schema)} of {self.schema.name}: "
                'expected beside it a file of the same name and .json that says {"schema": {"name", "keypoints", ...}}'
            )
        rows = openpifpaf_rows(instances, self.schema, file)
        uv, confidence = rows[..., :2], rows[..., 2]
        scores = [float(instance.get("score", 1.0)) for instance in instances]
        boxes = bounds(uv, confidence)
        return [
            CarDetection(uv[i], confidence[i].clip(0, 1), boxes[i], scores[i])
            for i in range(len(instances))
            if (confidence[i] > 0).any()
        ]


def _offer(image: Path, folder: Path, number: int) -> str:
    """Link an image into ``folder`` under a name that is plain and its own, whatever it is called elsewhere.

    OpenPifPaf would show its network the colours of transparent pixels: such images are drawn on white.
    """
    if is_transparent(image):
        name = f"{number:06d}.png"
        Image.fromarray(read_rgb(image)).save(folder / name)
    else:
        name = f"{number:06d}{image.suffix.lower()}"
        (folder / name).symlink_to(image.resolve())
    return name


def find_checkpoint(given: Path | None) -> tuple[str, str, KeypointSchema]:
    """What to call the checkpoint, what tells it from others, and the schema of its points.

    A name that OpenPifPaf knows, or a file; beside a file NAME.json may hold its ``schema``.
    """
    name = str(given or CHECKPOINT)
    schema = APOLLOCAR3D_24 if name.endswith("apollo-24") else APOLLOCAR3D_66
    if given is None or (len(given.parts) == 1 and not given.suffix and not given.exists()):
        return name, name, schema
    if not given.is_file():
        raise KroncError(f"checkpoint {given} does not exist: expected a checkpoint, or a name like {CHECKPOINT}")
    card = given.with_suffix(".json")
    if card.is_file():
        content = read_json(card)
        schema = read_schema(content.get("schema") if isinstance(content, dict) else None, card)
    return str(given.resolve()), file_sha256(given), schema
