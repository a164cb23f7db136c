"""The cloth simulator: scenes of effects, solvers, rollouts. Knows nothing of UV maps."""

from ._effect import Effect as Effect, Prepared as Prepared
from ._rollout import (
    Rollout as Rollout,
    lead_in as lead_in,
    simulate as simulate,
    simulate_batch as simulate_batch,
)
from ._scene import (
    STANDARD as STANDARD,
    PreparedScene as PreparedScene,
    Scene as Scene,
    prepare_scene as prepare_scene,
)
from ._xpbd import XPBD as XPBD, State as State, advance as advance
from .effects import (
    Bend as Bend,
    BodyContact as BodyContact,
    Damping as Damping,
    Gravity as Gravity,
    Pin as Pin,
    Stretch as Stretch,
)
