"""The table of search methods: to add one, write its file and add its row here."""

from inspe_jax.placement.methods.adam import ADAM
from inspe_jax.placement.methods.cma_es import CMA_ES
from inspe_jax.placement.methods.differences import DIFFERENCES
from inspe_jax.placement.methods.greedy import GREEDY, GREEDY_ADAM
from inspe_jax.placement.methods.grid import GRID
from inspe_jax.placement.methods.random_layouts import RANDOM
from inspe_jax.placement.methods.solver_rounds import LBFGSB, PROJECTED_GRADIENT
from inspe_jax.placement.run import Method

GRADIENTS: tuple[Method, ...] = (ADAM, GREEDY_ADAM, LBFGSB, PROJECTED_GRADIENT)
"""Those that follow the gradient of the soft score."""
SEARCHES: tuple[Method, ...] = (GRID, RANDOM, GREEDY, CMA_ES)
"""Those that need no gradient."""
CONTROLS: tuple[Method, ...] = (DIFFERENCES,)
"""The default with another slope; without one it is ``greedy``."""

METHODS: dict[str, Method] = {m.name: m for m in (*GRADIENTS, *SEARCHES, *CONTROLS)}
"""Every method by name. It is read whenever a search begins, so a row can be added at run time."""
