"""What a format leaves open of how files are written."""

from dataclasses import dataclass

from inspe_jax.core.errors import InspeError, check_known

PICTURES = ("png", "jpeg")
MOST_CAMERAS = 16


@dataclass(frozen=True)
class FileOptions:
    """How the files of a frame are written.

    ``pictures``: JPEG files are a quarter of the size of PNG and are read four times as fast, but
    few other readers look for them. ``cameras_per_agent``, for readers that want the same number
    of all; 0 leaves them as they are. ``infra_set_names`` gives the first point cloud of each agent
    a second name, ``_lidar0.pcd``, as the Infra-Set variant of OPV2V has it. ``visibility_maps``
    adds a picture of the road users that the cameras of each agent see, ``_bev_visibility.png``.
    """

    pictures: str = "png"
    cameras_per_agent: int = 0
    infra_set_names: bool = False
    visibility_maps: bool = False

    def check(self, where: str) -> None:
        """Raise InspeError where a value is out of range."""
        check_known(self.pictures, PICTURES, f"{where}: pictures:")
        if not 0 <= self.cameras_per_agent <= MOST_CAMERAS:
            raise InspeError(
                f"{where}: cameras_per_agent: {self.cameras_per_agent} is out of range: 1 to "
                f"{MOST_CAMERAS}, or 0 for as many as there are"
            )


DEFAULT_OPTIONS = FileOptions()
