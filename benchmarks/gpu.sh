#!/usr/bin/env bash
# Everything that a GPU is worth, in one command of at most 25 minutes: benchmarks/gpu.sh [FOLDER]
#
# The most valuable comes first, and each result is kept in FOLDER (default: benchmarks/gpu) as soon as it is there,
# with device and versions inside; machine.txt holds `envtf doctor`, and a .log lies beside each result. One such model
# does not fill a GPU: the robots of all comparisons train and are measured side by side, so that their train_seconds
# are of a shared machine; speeds are measured before and after, alone. What fails or runs out of time is named at the
# end; what it had measured by then lies in FOLDER/work, and with WORK the same call goes on where it stopped.
#
#   MINUTES=10 benchmarks/gpu.sh                  less time
#   WORK=.envtf/suite benchmarks/gpu.sh           keeps what was trained, too, and uses what lies there
#   QUICK=1 benchmarks/gpu.sh /tmp/try            every part on budgets of seconds, on any machine: a rehearsal
#   ENVTF="python -m envtf_lit" benchmarks/gpu.sh another way to call envtf
set -uo pipefail

out=${1:-benchmarks/gpu}
minutes=${MINUTES:-25}
read -ra envtf <<<"${ENVTF:-envtf}"
begin=$SECONDS
failed=()
work=${WORK:-$(mktemp -d)}
mkdir -p "$work" "$out/work"
trap 'keep; [[ -n ${WORK:-} ]] || rm -rf "$work"' EXIT

# keep: saves what was measured of each model, in FOLDER/work: of a robot that ran out of time nothing else is left
keep() {
  (cd "$work" && find . \( -name '*.json' -o -name curves.csv \) -print0 | tar -c --null -T -) | tar -x -C "$out/work"
}

# left: seconds until the time is over
left() {
  echo $((minutes * 60 - (SECONDS - begin)))
}

# measure NAME COMMAND…: runs `envtf COMMAND… --out FOLDER/NAME.json` within the time that is left
measure() {
  local name=$1
  shift
  if (($(left) <= 0)); then
    failed+=("$name (no time left)")
    return
  fi
  echo "$name: envtf $*"
  if timeout "$(left)" "${envtf[@]}" "$@" --out "$out/$name.json" >"$out/$name.log" 2>&1; then
    echo "  $((SECONDS - begin)) s so far: $out/$name.json"
  else
    failed+=("$name (see $out/$name.log)")
  fi
  keep
}

# aside NAME ROBOTS COMMAND…: the same for each robot alone, in the background, its result in FOLDER/work as soon as it is
# there; `measure NAME` then finds it all done
aside() {
  local name=$1 robot
  for robot in $2; do
    timeout "$(left)" "${envtf[@]}" "${@:3}" --robots "$robot" --out "$out/work/$name-$robot.json" \
      >"$out/$name-$robot.log" 2>&1 &
  done
}

speed=(bench model --rounds 3 --compile)
# as they are: so many models at once wait for each other on the GPU, not for their own processor
common=(--quiet --work "$work" --threads 2)
suite=("${common[@]}" --windows 256 --transitions 200000 --updates 6000 --ensemble-updates 16000)
hidden=("${common[@]}" --windows 128 --transitions 200000 --updates 10000 --ensemble-updates 20000)
calibrate=("${common[@]}" --windows 256 --updates 4000 --ensemble-updates 8000)
horizon=(--trajectories 300 --online 20)
robots="hopper halfcheetah walker2d ant"
changed="halfcheetah walker2d"
paper=paper small=small
if [[ -n ${QUICK:-} ]]; then
  speed=(bench model --rounds 1 --batch 64 --threads 1)
  suite=(--quiet --work "$work" --transitions 3000 --updates 20 --ensemble-updates 20 --threads 1)
  hidden=("${suite[@]}" --unseen 1000)
  calibrate=("${suite[@]}")
  horizon=(--trajectories 4 --online 2)
  robots=hopper
  changed=walker2d
  paper=tiny small=tiny
fi

"${envtf[@]}" doctor >"$out/machine.txt"
measure model_paper "${speed[@]}" --preset $paper --windows 256
aside hidden "$changed" hidden "${hidden[@]}"
aside horizon "$robots" horizon "${suite[@]}" "${horizon[@]}"
aside calibrate "$robots" calibrate "${calibrate[@]}"
wait
measure hidden hidden "${hidden[@]}" --robots $changed
measure horizon horizon "${suite[@]}" "${horizon[@]}" --robots $robots
measure calibrate calibrate "${calibrate[@]}" --robots $robots
measure model_small "${speed[@]}" --preset $small
measure cost bench cost "${suite[@]}"

echo "$((SECONDS - begin)) s in all; results in $out"
if ((${#failed[@]})); then
  printf 'not measured: %s\n' "${failed[@]}" >&2
  exit 1
fi
