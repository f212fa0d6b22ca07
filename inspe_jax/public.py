"""What ``inspe_jax`` lists, which imports this when a name is first read."""

from inspe_jax.core.errors import InspeError
from inspe_jax.core.numerics import Softness
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
from inspe_jax.scene.traffic.frames import MIXES, BodySize, Mix, TrafficFrames
from inspe_jax.scene.voxels import VoxelGrid
from inspe_jax.scoring.detection import (
    DetectionCurve,
    DetectionCurves,
    fit_detection,
    load_detection,
    save_detection,
)
from inspe_jax.scoring.evaluate import Contribution, ManyScores, Scores, evaluate, evaluate_many
from inspe_jax.scoring.metric import Evidence, Metric, TileEvidence
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
from inspe_jax.sensing.thermal import ThermalSpec
from inspe_jax.study.plan import Study, load_study
from inspe_jax.study.sweep import sweep
from inspe_jax.visibility.queries import in_view, line_of_sight

__all__ = [
    "BUILT_INS",
    "METHODS",
    "METRICS",
    "MIXES",
    "STRATEGIES",
    "BodySize",
    "CameraSpec",
    "Case",
    "Conditions",
    "Constraints",
    "Contribution",
    "DetectionCurve",
    "DetectionCurves",
    "Device",
    "Evidence",
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
    "Mix",
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
    "ThermalSpec",
    "TileEvidence",
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
