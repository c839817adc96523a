"""Keypoint files: ours, which is written too, and those of other tools (docs/keypoints.md has a line on each).

All become `Detections` in our pixels: the centre of the top-left one is at (0.5, 0.5).
"""

from kronc_ns.files.keypoints.detections import Detections as Detections
from kronc_ns.files.keypoints.detections import match_keypoints as match_keypoints
from kronc_ns.files.keypoints.detections import sigma_of as sigma_of
from kronc_ns.files.keypoints.detections import under_file_names as under_file_names
from kronc_ns.files.keypoints.openpifpaf import openpifpaf_rows as openpifpaf_rows
from kronc_ns.files.keypoints.openpifpaf import read_predictions as read_predictions
from kronc_ns.files.keypoints.own import write_keypoints as write_keypoints
from kronc_ns.files.keypoints.reading import FORMATS as FORMATS
from kronc_ns.files.keypoints.reading import read_keypoints as read_keypoints
from kronc_ns.files.keypoints.schemas import describe_schema as describe_schema
from kronc_ns.files.keypoints.schemas import read_schema as read_schema
