"""What the triangles of the static world are made of."""

MATERIALS = (
    *("ground", "kerb", "building", "roof", "trunk", "crown", "pole"),
    *("wall", "furniture", "parked car", "parked truck", "surveyed"),
)
"""A face of the static world has an index into this as its material. That of a parked vehicle or of
a mesh has a colour of its own."""
GROUND, KERB, BUILDING, ROOF, TRUNK, CROWN, POLE = range(7)
WALL, FURNITURE, PARKED_CAR, PARKED_TRUCK, SURVEYED = range(7, len(MATERIALS))
COLOURED = (PARKED_CAR, PARKED_TRUCK, SURVEYED)
