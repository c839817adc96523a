"""TEMPORARY bridge to the old solver while the house moves; replaced before landing."""
import dataclasses
import sys
from collections.abc import Callable

import numpy as np

from kronc_ns.errors import KroncError
from kronc_ns.fit.options import KroncConfig
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewReport, ViewStatus

Progress = Callable[[int, int, float], None]

def _old_scene(scene):
    import kronc_old.geometry.camera as oc
    import kronc_old.keypoints.schema as ok
    import kronc_old.scene as o
    import torch
    t = lambda x: None if x is None else torch.from_numpy(np.ascontiguousarray(x))
    f = {f.name: getattr(scene.schema, f.name) for f in dataclasses.fields(scene.schema)}
    return o.Scene(scene.names, oc.Camera(**dataclasses.asdict(scene.camera)), ok.KeypointSchema(**f), t(scene.keypoints), t(scene.given_c2w), t(scene.given_depths), scene.masks, scene.notes)

def solve_scenes(scenes, config=None, progress=None):
    import kronc_old.pipeline as op
    import kronc_old.solve.adam as oa
    import kronc_old.solve.lm as ol

    from kronc_ns.geometry.camera import Camera
    config = config or KroncConfig()
    d = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    d["adam"] = oa.AdamConfig(**dataclasses.asdict(config.adam)); d["lm"] = ol.LmConfig(**dataclasses.asdict(config.lm))
    out = []
    for s in op.solve_scenes([_old_scene(x) for x in scenes], op.KroncConfig(**d), progress):
        if isinstance(s, Exception):
            out.append(KroncError(str(s))); continue
        v = {f.name: getattr(s, f.name) for f in dataclasses.fields(s)}
        for k in ("c2w", "points", "depths", "initial_c2w", "path"):
            v[k] = None if v[k] is None else v[k].numpy()
        v["status"] = Status(s.status.value); v["camera"] = Camera(**dataclasses.asdict(s.camera))
        v["views"] = tuple(ViewReport(**{**{f.name: getattr(x, f.name) for f in dataclasses.fields(x)}, "status": ViewStatus(x.status.value)}) for x in s.views)
        out.append(Solution(**v))
    return out

def solve_scene(scene, config=None, progress=None):
    (s,) = solve_scenes([scene], config, progress)
    if isinstance(s, KroncError):
        raise s
    return s
