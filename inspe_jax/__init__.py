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
  Z levels, T frames, B boxes, R rays, G groups of sensors that may fail: row 0 of 1 + G
  is of all sensors.

Public is what this package, :mod:`inspe_jax.report`, :mod:`inspe_jax.dataset`, its ``loading`` and
:mod:`inspe_jax.perception.training` list. Examples in docstrings have these by their last name,
NumPy as ``np``, the files of ``inspe examples``, and a small scene and a layout:

>>> scene = inspe_jax.build_scene("four_way", radius=15, spacing=2.0, frames=4, seed=0)
>>> layout = inspe_jax.strategy(scene, "Cam-d1")
"""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's alarm of slow compiling is an error log

from inspe_jax.core.version import __version__ as __version__

if TYPE_CHECKING:
    from inspe_jax.public import *  # noqa: F403
    from inspe_jax.public import __all__ as __all__
else:  # a checker of types would take every name for known

    def __getattr__(name: str) -> Any:
        return getattr(import_module("inspe_jax.public"), name)

    if "jax" in sys.modules:  # what its user compiles is kept too
        import_module("inspe_jax.core.kept")


def __dir__() -> list[str]:
    return [*globals(), *import_module("inspe_jax.public").__all__]
