#!/usr/bin/env bash
# Everything that waits for a CUDA machine, without a network:
#
#   python experiments/cuda/pack.py           where the motions and a package registry are
#   bash experiments/cuda/run.sh [PART ...]   there: what is measured (measure.py)
#   bash experiments/cuda/run.sh learn        there: networks from data made there (learn.py)
#
# out/cuda travels with the tracked files. Results: $OUT (out/cuda/results by default).
set -euo pipefail
cd "$(dirname "$0")/../.."
export PACK="${PACK:-out/cuda}" OUT="${OUT:-out/cuda/results}"
export PYTHONUNBUFFERED=1 TF_CPP_MIN_LOG_LEVEL=2
python="${PYTHON:-python3}"
mkdir -p "$OUT"
if compgen -G "$PACK/wheels/*.whl" > /dev/null; then
  site="$(mktemp -d)"
  "$python" -m pip install --quiet --no-index --no-deps --no-compile --target "$site" "$PACK"/wheels/*.whl
  export PYTHONPATH="$site"
fi
export PYTHONPATH="src${PYTHONPATH:+:$PYTHONPATH}"
script=measure
if [[ "${1:-}" == learn ]]; then
  script=learn
  shift
fi
"$python" "experiments/cuda/$script.py" "$@" 2>&1 | tee "$OUT/$script.txt"
