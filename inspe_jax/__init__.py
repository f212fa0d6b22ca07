"""Score and optimise where roadside cameras, LiDARs and radars go at road intersections.

Conventions, stated once:

- World frame: east-north-up, right-handed, metres, radians.
- Yaw is counter-clockwise from +x, pitch is positive nose-up, roll is about the
  forward axis: R = Rz(yaw) · Ry(−pitch) · Rx(roll). A pose is (x, y, z, roll,
  pitch, yaw).
- Sensor body frame: x forward, y left, z up, for cameras too.
- Files written by people use degrees and say so in the key (``yaw_deg``).
- Compiled programs are kept in the user's cache folder, unless INSPE_CACHE is 0 or JAX is given
  another folder.
- Axis letters in shapes: S sensors, U infrastructure units, V voxels, L columns,
  Z levels, T frames, B boxes, R rays.

Public is what this package, :mod:`inspe_jax.report`, :mod:`inspe_jax.dataset`, its ``loading`` and
:mod:`inspe_jax.perception.training` list. Examples in docstrings have these by their last name,
NumPy as ``np``, the files of ``inspe examples``, and a small scene and a layout:

>>> scene = inspe_jax.build_scene("four_way", radius=15, spacing=2.0, frames=4, seed=0)
>>> layout = inspe_jax.strategy(scene, "Cam-d1")
"""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's alarm of slow compiling is an error log

from inspe_jax.core.compiling import NOTHING, keep_programs
from inspe_jax.core.errors import InspeError
from inspe_jax.core.numerics import Softness
from inspe_jax.core.version import __version__ as __version__
from inspe_jax.mounting.strategies import STRATEGIES, strategy
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.methods.registry import METHODS
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import compare, methods, optimise
from inspe_jax.placement.result import Result, load_result, save_result
from inspe_jax.placement.run import Method
from inspe_jax.placement.studies.pareto import cheapest, pareto
from inspe_jax.placement.studies.tolerance import tolerance
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.maps.own_regions import intersection_of
from inspe_jax.scene.maps.registry import junction_at, list_junctions, read_map
from inspe_jax.scene.procedural.built_ins import BUILT_INS, built_in
from inspe_jax.scene.profiles import Profile, profiles
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene, build_scene, load_scene, save_scene
from inspe_jax.scene.traffic.frames import TrafficFrames
from inspe_jax.scene.voxels import VoxelGrid
from inspe_jax.scoring.detection import (
    DetectionCurve,
    DetectionCurves,
    fit_detection,
    load_detection,
    save_detection,
)
from inspe_jax.scoring.evaluate import Contribution, ManyScores, Scores, evaluate, evaluate_many
from inspe_jax.scoring.metric import Metric
from inspe_jax.scoring.metrics import METRICS
from inspe_jax.scoring.targets import TargetView, target_view
from inspe_jax.sensing.calibrations import Imported, layouts_from
from inspe_jax.sensing.catalogue import Device, device, devices
from inspe_jax.sensing.conditions import Case, Conditions
from inspe_jax.sensing.layout import Layout, Sensor, Unit, load_layout, make_layout, save_layout
from inspe_jax.sensing.lens import Lens
from inspe_jax.sensing.pose_solver import PoseFit, solve_pose
from inspe_jax.sensing.radar import RadarSpec
from inspe_jax.sensing.ray_grid import RayGrid
from inspe_jax.sensing.rays import SphericalRays
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec, Pose, Spec
from inspe_jax.study.plan import Study, load_study
from inspe_jax.study.sweep import sweep
from inspe_jax.visibility.queries import in_view, line_of_sight

if os.environ.get("INSPE_CACHE", "").lower() not in NOTHING:
    keep_programs()

__all__ = [
    "BUILT_INS",
    "METHODS",
    "METRICS",
    "STRATEGIES",
    "CameraSpec",
    "Case",
    "Conditions",
    "Constraints",
    "Contribution",
    "DetectionCurve",
    "DetectionCurves",
    "Device",
    "Georeference",
    "Imported",
    "InspeError",
    "Intersection",
    "Layout",
    "Lens",
    "LidarSpec",
    "ManyScores",
    "Method",
    "Metric",
    "Objective",
    "Pose",
    "PoseFit",
    "Profile",
    "RadarSpec",
    "RayGrid",
    "Region",
    "Result",
    "Scene",
    "Scores",
    "Sensor",
    "Softness",
    "Spec",
    "SphericalRays",
    "Study",
    "TargetView",
    "TrafficFrames",
    "Unit",
    "VoxelGrid",
    "build_scene",
    "built_in",
    "cheapest",
    "compare",
    "device",
    "devices",
    "evaluate",
    "evaluate_many",
    "fit_detection",
    "in_view",
    "intersection_of",
    "junction_at",
    "layouts_from",
    "line_of_sight",
    "list_junctions",
    "load_detection",
    "load_layout",
    "load_result",
    "load_scene",
    "load_study",
    "make_layout",
    "methods",
    "optimise",
    "pareto",
    "profiles",
    "read_map",
    "save_detection",
    "save_layout",
    "save_result",
    "save_scene",
    "solve_pose",
    "strategy",
    "sweep",
    "target_view",
    "tolerance",
]
