"""Metrics and reports: what an answer is worth, and what holds where it is hard."""

from ._bench import (
    JITTER as JITTER,
    BenchScene as BenchScene,
    Work as Work,
    bench_scenes as bench_scenes,
    bench_simulation as bench_simulation,
    solvers as solvers,
    time_to_error as time_to_error,
)
from ._metrics import VertexError as VertexError, vertex_error as vertex_error
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
from ._textile import (
    DRAPE_BANDS as DRAPE_BANDS,
    Cantilever as Cantilever,
    Drape as Drape,
    cantilever_test as cantilever_test,
    drape_test as drape_test,
)
