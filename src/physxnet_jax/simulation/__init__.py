"""The cloth simulator: scenes of effects, solvers and rollouts, independent of UV maps."""

from ._advance import (
    advance as advance,
    advance_frame as advance_frame,
    skin_effects as skin_effects,
    start_state as start_state,
)
from ._assembly import Assembly as Assembly
from ._diagnostics import OFF as OFF, Rollout as Rollout, Status as Status
from ._effect import (
    Clock as Clock,
    Effect as Effect,
    PosedPoints as PosedPoints,
    Prepared as Prepared,
)
from ._elastic_tables import ElasticTables as ElasticTables, elastic_tables as elastic_tables
from ._implicit import Implicit as Implicit
from ._potential import incremental_potential as incremental_potential
from ._prepared_scene import PreparedScene as PreparedScene
from ._resume import QUICK as QUICK, Resume as Resume, fingerprint as fingerprint
from ._rollout import (
    PRESETS as PRESETS,
    ROLLOUT_BLOCK as ROLLOUT_BLOCK,
    Accuracy as Accuracy,
    simulate as simulate,
    simulate_batch as simulate_batch,
    warmup as warmup,
)
from ._scene import (
    EFFECTS as EFFECTS,
    STANDARD as STANDARD,
    Scene as Scene,
    make_system as make_system,
    needs_floor as needs_floor,
    prepare_scene as prepare_scene,
    standard_effects as standard_effects,
)
from ._slip import slipped as slipped
from ._solver import Solver as Solver
from ._state import State as State, System as System
from ._static_body import settle_on_static_body as settle_on_static_body
from ._verlet import Verlet as Verlet
from ._xpbd import XPBD as XPBD
