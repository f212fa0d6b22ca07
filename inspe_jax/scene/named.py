"""Scenes as users give them: as such, or by name."""

import os
from functools import lru_cache
from typing import Any

from inspe_jax.core.errors import wrong_kind
from inspe_jax.core.files import cached_by_file
from inspe_jax.scene.procedural.built_ins import BUILT_INS
from inspe_jax.scene.scene import Scene, load_scene


def scene_of(given: Any) -> Scene:
    """A scene that is given as such, or by the name of a built-in or of a saved file; checked.

    Raises InspeError as :func:`load_scene` does, as :meth:`Scene.check` does, and for anything
    else than a scene.
    """
    if isinstance(given, str | os.PathLike):
        if given in BUILT_INS:
            return _named(given)
        return _saved(given) if os.path.isfile(given) else load_scene(given)  # says what is wrong
    if not isinstance(given, Scene):
        raise wrong_kind(
            "scene",
            given,
            f"a Scene, or the name of a built-in ({', '.join(BUILT_INS)}) or of a saved .npz file",
        )
    return given.check()


# Or each score in a loop would build or read it again.
_named = lru_cache(maxsize=2)(load_scene)
_saved = cached_by_file(2)(load_scene)
