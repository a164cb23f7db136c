"""Metrics and reports: what an answer is worth, and what holds where it is hard."""

from ._baselines import (
    nearest_frame as nearest_frame,
    pose_features as pose_features,
    pose_network as pose_network,
    training_frames as training_frames,
)
from ._bench import (
    JITTER as JITTER,
    BenchScene as BenchScene,
    Work as Work,
    bench_scenes as bench_scenes,
    bench_simulation as bench_simulation,
    solvers as solvers,
    time_to_error as time_to_error,
)
from ._dataset_check import check_sequence as check_sequence
from ._evaluate import (
    DIGITS as DIGITS,
    ActionError as ActionError,
    evaluate as evaluate,
    means as means,
    retime as retime,
)
from ._methods import (
    ENGINES as ENGINES,
    NOISE as NOISE,
    Answer as Answer,
    Blockwise as Blockwise,
    Method as Method,
    Simulator as Simulator,
    engine as engine,
    network as network,
    rest_and_skin as rest_and_skin,
    skinning as skinning,
)
from ._metrics import VertexError as VertexError, vertex_error as vertex_error
from ._motion_metrics import (
    acceleration_error as acceleration_error,
    area_strain as area_strain,
    dihedral_angles as dihedral_angles,
    fold_strength as fold_strength,
    jitter as jitter,
    wrinkle_error as wrinkle_error,
)
from ._penetration import Penetration as Penetration, penetration as penetration
from ._price import (
    Advice as Advice,
    Price as Price,
    price_effects as price_effects,
    recommend_effects as recommend_effects,
)
from ._strain import edge_strain as edge_strain
from ._stress import CASES as CASES, Finding as Finding, run_case as run_case
from ._stress_worn import PEER_CASES as PEER_CASES, run_peer as run_peer
from ._tables import error_tables as error_tables, summary_table as summary_table
from ._textile import (
    DRAPE_BANDS as DRAPE_BANDS,
    Cantilever as Cantilever,
    Drape as Drape,
    cantilever_test as cantilever_test,
    drape_test as drape_test,
)
