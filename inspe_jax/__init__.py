"""Score and optimise the placement of roadside cameras and LiDARs at road intersections.

Conventions, stated once:

- World frame: east-north-up, right-handed, metres, radians.
- Yaw is counter-clockwise from +x, pitch is positive nose-up, roll is about the
  forward axis: R = Rz(yaw) · Ry(−pitch) · Rx(roll). A pose is (x, y, z, roll,
  pitch, yaw).
- Sensor body frame: x forward, y left, z up, for cameras too.
- Files written by people use degrees and say so in the key (``yaw_deg``).
- Axis letters in shapes: S sensors, U infrastructure units, V voxels, L columns,
  Z levels, T frames, B boxes, R rays.
"""

__version__ = "0.1.0"
