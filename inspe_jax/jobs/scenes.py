"""What a worker needs for any job: the scene of a source, and a layout on it."""

from functools import cache
from pathlib import Path
from typing import Any

import jax

from inspe_jax.core import version
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_input, digest_of, parse_yaml
from inspe_jax.core.parallel import compiled
from inspe_jax.jobs.sources import LayoutSource, SceneSource
from inspe_jax.mounting.mixes import starting_layout
from inspe_jax.mounting.strategies import strategy
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import Scene, build_scene, load_scene
from inspe_jax.sensing.layout import Layout, parse_layout

COMPILED_SCENES = 6
"""Most scenes whose compiled programs a worker keeps; programs depend on a scene's shapes."""

_compiled_for: set[str] = set()


@cache
def versions() -> dict[str, str]:
    """Versions that a result depends on."""
    return version.versions(("jax", "numpy"))


def scene_of(source: SceneSource, settings: dict[str, Any]) -> Scene:
    """Build the scene of a source with ``settings``, or load a saved one.

    Raises InspeError if its file is missing or has changed since the study was read, or as
    building does.
    """
    if source.built_in is not None:
        return build_scene(built_in(source.built_in), **settings)
    path = Path(str(source.map or source.file))
    check_input(path)
    if digest_of(path) != source.content:
        raise InspeError(f"{path}: has changed since the study was read")
    if source.file is not None:
        return load_scene(path)
    from inspe_jax.scene.maps.registry import read_map

    at: dict[str, Any] = dict(junction=source.junction, center=source.center)
    return build_scene(read_map(path, **at, radius=settings["radius"]), **settings)


def scene_or_message(source: SceneSource, settings: dict[str, Any]) -> Scene | str:
    """The scene of a source; or the message of the error, if it cannot be built."""
    try:
        return scene_of(source, settings)
    except Exception as e:
        return message_of(e)


def place_layout(source: LayoutSource, scene: Scene) -> Layout:
    """The layout of a source on a scene. A mix stands as :func:`starting_layout` places it."""
    if source.mix:
        return starting_layout(scene, dict(source.mix), dict(source.options))
    if source.strategy is not None:
        return strategy(scene, source.strategy, **dict(source.options))
    assert source.text is not None
    return parse_layout(parse_yaml(source.text, source.name), source.name, source.name, scene)


def release_compiled(scene: str) -> None:
    """Drop the programs compiled for earlier scenes, once there are many scenes."""
    if scene not in _compiled_for and len(_compiled_for) >= COMPILED_SCENES:
        jax.clear_caches()
        compiled.clear()
        _compiled_for.clear()
    _compiled_for.add(scene)


def message_of(e: Exception) -> str:
    """An exception in words: the message alone if it is an InspeError."""
    return str(e) if isinstance(e, InspeError) else f"{type(e).__name__}: {e}"
