"""The cloth simulator: scenes of effects, solvers, rollouts. Knows nothing of UV maps."""

from ._advance import advance as advance, start_state as start_state
from ._assembly import Assembly as Assembly
from ._diagnostics import Rollout as Rollout, Status as Status
from ._effect import (
    Attached as Attached,
    Clock as Clock,
    Effect as Effect,
    Placed as Placed,
    Prepared as Prepared,
)
from ._implicit import Implicit as Implicit
from ._rollout import (
    ACCURACY as ACCURACY,
    ROLLOUT_BLOCK as ROLLOUT_BLOCK,
    lead_in as lead_in,
    simulate as simulate,
    simulate_batch as simulate_batch,
)
from ._scene import (
    EFFECTS as EFFECTS,
    STANDARD as STANDARD,
    PreparedScene as PreparedScene,
    Scene as Scene,
    prepare_scene as prepare_scene,
    standard_effects as standard_effects,
)
from ._solver import Solver as Solver
from ._state import State as State, System as System
from ._still import simulate_still as simulate_still
from ._verlet import Verlet as Verlet
from ._xpbd import XPBD as XPBD
from .effects import (
    Air as Air,
    Bend as Bend,
    BodyContact as BodyContact,
    Damping as Damping,
    Dihedral as Dihedral,
    Gravity as Gravity,
    LayerContact as LayerContact,
    Membrane as Membrane,
    Pin as Pin,
    Seam as Seam,
    SelfContact as SelfContact,
    StrainLimit as StrainLimit,
    Stretch as Stretch,
)
