"""Accuracy metrics, robustness reports and cost tables of dressing methods."""

from . import _stress_clothes as _stress_clothes  # its cases join `CASES`
from ._baselines import (
    nearest_frame as nearest_frame,
    pose_features as pose_features,
    pose_network as pose_network,
    training_frames as training_frames,
)
from ._bench import (
    JITTER as JITTER,
    Work as Work,
    bench_scenes as bench_scenes,
    bench_simulation as bench_simulation,
    solvers as solvers,
    time_to_error as time_to_error,
)
from ._cost import (
    Cost as Cost,
    mean_errors as mean_errors,
    network_costs as network_costs,
    network_errors as network_errors,
    other_costs as other_costs,
    present_devices as present_devices,
)
from ._cost_points import (
    cost_points as cost_points,
    engine_times as engine_times,
    noise_floors as noise_floors,
)
from ._cost_table import (
    ALONE_AND_TOGETHER as ALONE_AND_TOGETHER,
    MethodProfile as MethodProfile,
    Selection as Selection,
    calibrate as calibrate,
    calibration_file as calibration_file,
    choose_method as choose_method,
    load_cost_table as load_cost_table,
    select_method as select_method,
    worn_key as worn_key,
)
from ._dataset_check import check_sequence as check_sequence
from ._evaluate import (
    ActionError as ActionError,
    action_name as action_name,
    evaluate as evaluate,
    means as means,
    retime as retime,
)
from ._evaluate_dataset import evaluate_dataset as evaluate_dataset
from ._likeness import Likeness as Likeness, likeness as likeness
from ._method_names import (
    MIRROR as MIRROR,
    method_by_name as method_by_name,
    method_name as method_name,
    parse_method as parse_method,
)
from ._methods import (
    Method as Method,
    Prediction as Prediction,
    network as network,
    skinning as skinning,
)
from ._metrics import vertex_error as vertex_error
from ._motion_metrics import (
    acceleration_error as acceleration_error,
    area_strain as area_strain,
    dihedral_angles as dihedral_angles,
    fold_spectrum as fold_spectrum,
    fold_strength as fold_strength,
    jitter as jitter,
    spectrum_distance as spectrum_distance,
    wrinkle_error as wrinkle_error,
)
from ._network_bench import (
    NetworkBench as NetworkBench,
    bench_networks as bench_networks,
    evaluated_errors as evaluated_errors,
)
from ._penetration import penetration as penetration
from ._price import (
    judge_effects as judge_effects,
    price_effects as price_effects,
    recommend_effects as recommend_effects,
    recommended_effects as recommended_effects,
)
from ._saved_rows import (
    check_rows_file as check_rows_file,
    machine as machine,
    read_rows as read_rows,
    row_json as row_json,
    save_rows as save_rows,
)
from ._strain import edge_strain as edge_strain
from ._stress import CASES as CASES, Finding as Finding, run_case as run_case
from ._stress_worn import PEER_CASES as PEER_CASES, run_peer as run_peer
from ._surface_faults import SurfaceFaults as SurfaceFaults, surface_faults as surface_faults
from ._tables import (
    cost_rows_table as cost_rows_table,
    error_tables as error_tables,
    summary_table as summary_table,
    work_tables as work_tables,
)
from ._textile import (
    DRAPE_BANDS as DRAPE_BANDS,
    cantilever_test as cantilever_test,
    drape_test as drape_test,
)
