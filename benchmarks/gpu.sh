#!/usr/bin/env bash
# Everything that a GPU is worth, in one command of at most 25 minutes: benchmarks/gpu.sh [FOLDER]
#
# The most valuable comes first, and each result is kept in FOLDER (default: benchmarks/gpu) as soon as it is there, with
# device and versions inside; machine.txt holds `envtf doctor`, and a .log lies beside each result. What fails or runs
# out of time is named at the end; what it had measured by then lies in FOLDER/work.
#
#   MINUTES=10 benchmarks/gpu.sh                  less time
#   QUICK=1 benchmarks/gpu.sh /tmp/try            every part on budgets of seconds, on any machine: a rehearsal
#   ENVTF="python -m envtf_lit" benchmarks/gpu.sh another way to call envtf
set -uo pipefail

out=${1:-benchmarks/gpu}
minutes=${MINUTES:-25}
read -ra envtf <<<"${ENVTF:-envtf}"
begin=$SECONDS
failed=()
mkdir -p "$out"
work=$(mktemp -d)
trap 'keep; rm -rf "$work"' EXIT

# keep: saves what was measured of each model, in FOLDER/work: of a comparison that ran out of time nothing else is left
keep() {
  mkdir -p "$out/work"
  (cd "$work" && find . -name '*.json' -print0 | tar -c --null -T -) | tar -x -C "$out/work"
}

# measure NAME COMMAND…: runs `envtf COMMAND… --out FOLDER/NAME.json` within the time that is left
measure() {
  local name=$1 left=$((minutes * 60 - (SECONDS - begin)))
  shift
  if ((left <= 0)); then
    failed+=("$name (no time left)")
    return
  fi
  echo "$name: envtf $*"
  if timeout "$left" "${envtf[@]}" "$@" --out "$out/$name.json" >"$out/$name.log" 2>&1; then
    echo "  $((SECONDS - begin)) s so far: $out/$name.json"
  else
    failed+=("$name (see $out/$name.log)")
  fi
  keep
}

small=(--rounds 5)
paper=(--rounds 3 --batch 2048)
suite=(--transitions 200000 --updates 20000)
robots=()
horizon=()
hidden=()
if [[ -n ${QUICK:-} ]]; then
  small=(--rounds 1 --batch 64 --preset tiny --threads 1)
  paper=("${small[@]}")
  suite=(--transitions 3000 --updates 20 --ensemble-updates 20 --threads 1)
  robots=(--robots hopper)
  horizon=(--trajectories 4 --online 2)
  hidden=(--robots walker2d --unseen 1000)
fi

"${envtf[@]}" doctor >"$out/machine.txt"
measure model_paper bench model --preset paper "${paper[@]}"
measure model_small bench model --preset small "${small[@]}"
measure model_base bench model --preset base "${small[@]}"
measure cost bench cost --quiet --work "$work" "${suite[@]}"
measure calibrate calibrate --quiet --work "$work" "${suite[@]}" "${robots[@]}"
measure horizon horizon --quiet --work "$work" "${suite[@]}" "${robots[@]}" "${horizon[@]}"
measure hidden hidden --quiet --work "$work" "${suite[@]}" "${hidden[@]}"
measure model_small_fp32 bench model --preset small --precision fp32 "${small[@]}"

echo "$((SECONDS - begin)) s in all; results in $out"
if ((${#failed[@]})); then
  printf 'not measured: %s\n' "${failed[@]}" >&2
  exit 1
fi
