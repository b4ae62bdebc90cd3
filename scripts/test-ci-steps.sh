#!/usr/bin/env bash
# Tests the runner of .ci/run with steps that sleep, fail and leave processes behind.
# shellcheck disable=SC2016,SC2317
set -euo pipefail
cd "$(dirname "$0")"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
failed=0

# Runs declared steps with two cores, and stores the output and the exit code.
run() { # DECLARATIONS
    code=0
    SCRATCH=$scratch CI_CPU=200 bash -euo pipefail -c "source ./ci-steps.sh; $1
run_steps" >"$scratch/out" 2>&1 || code=$?
}
check() { # WHAT CONDITION...
    if "${@:2}"; then echo "passed: $1"; else
        echo "FAILED: $1"
        sed 's/^/    /' "$scratch/out"
        failed=1
    fi
}
has() { grep -qE "$1" "$scratch/out"; }
lacks() { ! has "$1"; }

# Writes its beginning and its end to a common file.
timed='timed() { echo "$1 begins" >>"$SCRATCH/order"; sleep "$2"; echo "$1 ends" >>"$SCRATCH/order"; }'

run "$timed
step one 100 - timed one 3
step two 100 - timed two 3
step three 100 - timed three 0
step after-one 50 one timed after-one 0
step single alone - timed single 0.5
step later 10 - timed later 0"
check "steps that pass give exit code 0" [ $code = 0 ]
check "two steps run side by side, a third waits for a place" \
    grep -qE '^(one|two) begins (one|two) begins (one|two) ends' <<<"$(paste -sd' ' "$scratch/order")"
check "a step starts after those it names" grep -q 'one ends.* after-one begins' <<<"$(paste -sd' ' "$scratch/order")"
check "nothing runs beside a step that wants to be alone" grep -q 'single begins single ends' <<<"$(paste -sd' ' "$scratch/order")"
check "nothing below it starts before" grep -q 'single ends later begins' <<<"$(paste -sd' ' "$scratch/order")"
check "the table has each step and the total" [ "$(grep -cE '^(one|two|three|after-one|single|later) .* passed$|^total' "$scratch/out")" = 7 ]

run 'left_behind() { sleep 300 & echo $! >"$SCRATCH/left"; }
stops_at_once() { false; echo unreachable; }
slow() { trap "echo cleaned >>$SCRATCH/cleaned" EXIT; sleep 300; }
step left-behind 10 - left_behind
step slow 100 - slow
step bad 100 left-behind stops_at_once
step never 10 bad true'
check "a failure is the exit code of the run" [ $code = 1 ]
check "the step that failed is named with the end of its log" has '^bad: FAILED \(exit status 1\)\. The end of its log:'
check "a function fails at its first command that fails" lacks unreachable
check "what runs is stopped, with time to clean up" [ "$(cat "$scratch/cleaned")" = cleaned ]
check "the table says what failed, was stopped and did not run" \
    [ "$(grep -cE '^bad .* FAILED \(exit status 1\)$|^slow .* stopped$|^never .* not run$|^left-behind .* passed$' "$scratch/out")" = 4 ]
# A finished process may still be in the process table.
check "no process stays behind" [ "$(ps -o stat= -p "$(cat "$scratch/left")" | grep -vc Z)" = 0 ]

run 'step noisy 10 - bash -c "echo to stdout; echo to stderr >&2; cat; exit 3"
step quiet 10 - echo "test result: ok. 7 passed"'
check "a log has both outputs, and no step waits for input" [ "$(grep -cE '^to std(out|err)$' "$scratch/out")" -ge 2 ]
check "the exit status of a failed step is printed" has '^noisy .* FAILED \(exit status 3\)$'
check "the run fails" [ $code = 1 ]

run 'step killed 10 - bash -c "kill -KILL 0"'
check "a step that was killed with its group has failed" has '^killed .* FAILED \(exit status unknown\)$'

run 'step large 900 - true'
check "a step that wants more than the machine has runs all the same" [ $code = 0 ]

run 'step one 10 nothing true'
check "an unknown name is told before anything runs" [ $code = 2 ]

CI_CPU=200 SCRATCH=$scratch bash -c "source ./ci-steps.sh; $timed; step long 100 - timed long 300; run_steps" >"$scratch/out" 2>&1 &
runner=$!
until has '^-- long starts'; do sleep 0.1; done
kill -TERM $runner
wait $runner || code=$?
check "a run that is interrupted stops its steps and prints the table" has '^long .* stopped$'
check "and fails" [ $code = 143 ]
exit $failed
