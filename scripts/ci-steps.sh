# shellcheck shell=bash
# Runs the steps of a check side by side. To be sourced by bash 5; scripts/test-ci-steps.sh tests it.
#
#   step NAME CPU AFTER COMMAND...   declares a step
#   run_steps                        runs all steps; fails if one fails
#
# NAME has lower-case letters, digits and hyphens. COMMAND may be a function; it sees exported variables only, and fails at its first command that fails.
# CPU is how much of one core the step keeps busy, in percent. Steps run side by side while their sum fits the machine's cores.
# `alone` means that no other step runs at the same time: for steps that measure times. Once it may start, no step below it starts before it.
# AFTER names the steps that must have passed before, separated by commas; `-` means none.
#
# Each step writes to a log file of its own, which is printed when the step ends. The exit status of a failed step is printed as well. After the
# first failure no other step starts, and those that run are stopped. A table of seconds is printed at the end, also after a failure. CI_CPU
# overrides the capacity, which is the number of cores times 100.

step_names=()
declare -A step_cpu step_after step_command step_state step_began step_seconds step_pid step_log
failed_step=

step() { # NAME CPU AFTER COMMAND...
    local name=$1 before
    [[ $name =~ ^[a-z0-9-]+$ ]] || { echo "step $name: a name has lower-case letters, digits and hyphens" >&2; exit 2; }
    [ -z "${step_state[$name]:-}" ] || { echo "step $name is declared twice" >&2; exit 2; }
    for before in ${3//,/ }; do
        [ "$before" = - ] || [ -n "${step_state[$before]:-}" ] || { echo "step $name: there is no step $before above it" >&2; exit 2; }
    done
    step_names+=("$name")
    step_cpu[$name]=$2
    step_after[$name]=$3
    printf -v "step_command[$name]" '%q ' "${@:4}"
    step_state[$name]='not run'
}

# Returns the names of the steps in this state.
steps_that_are() { # STATE
    local name
    for name in "${step_names[@]}"; do
        if [ "${step_state[$name]}" = "$1" ]; then echo "$name"; fi
    done
}

# Returns whether the steps before it have passed.
is_ready() { # NAME
    local name
    for name in ${step_after[$1]//,/ }; do
        [ "$name" = - ] || [ "${step_state[$name]}" = passed ] || return 1
    done
}

# Returns whether it fits next to the running steps.
has_room() { # NAME
    local name used=0
    for name in $(steps_that_are running); do
        [ "$1" != "$name" ] && [ "${step_cpu[$1]}" != alone ] && [ "${step_cpu[$name]}" != alone ] || return 1
        used=$((used + step_cpu[$name]))
    done
    # A step that needs more than the machine has runs by itself.
    [ $used = 0 ] || [ $((used + step_cpu[$1])) -le "$capacity" ]
}

# Runs the command of a step and stores its exit status in a file, which is missing if the step was killed.
run_command() { # NAME
    local code=0
    # Not ended by the signal itself: the command gets it as well, and needs time to clean up.
    trap : INT TERM
    bash -euo pipefail -c "$(declare -f)"$'\n'"${step_command[$1]}" || code=$?
    echo $code >"${step_log[$1]}.status"
}

start_steps() {
    local name waiting
    mapfile -t waiting < <(steps_that_are 'not run')
    for name in "${waiting[@]}"; do
        if ! is_ready "$name"; then continue; fi
        if ! has_room "$name"; then
            [ "${step_cpu[$name]}" != alone ] || return 0
            continue
        fi
        step_state[$name]=running
        step_began[$name]=$SECONDS
        echo "-- $name starts (${SECONDS} s)"
        # In a process group of its own.
        set -m
        run_command "$name" </dev/null >"${step_log[$name]}" 2>&1 &
        step_pid[$name]=$!
        set +m
    done
}

# Records the result of a finished step.
end_step() { # NAME
    local code=
    wait "${step_pid[$1]}" || true
    # Without the file, the step was killed.
    [ ! -e "${step_log[$1]}.status" ] || code=$(<"${step_log[$1]}.status")
    # Processes that it left running.
    kill -KILL -- "-${step_pid[$1]}" 2>/dev/null || true
    step_seconds[$1]=$((SECONDS - step_began[$1]))
    step_state[$1]=passed
    if [ "$code" != 0 ]; then
        step_state[$1]="FAILED (exit status ${code:-unknown})"
        failed_step=${failed_step:-$1}
    fi
    printf '\n== %s: %s after %s s\n' "$1" "${step_state[$1]}" "${step_seconds[$1]}"
    cat "${step_log[$1]}"
}

end_steps() {
    local name
    for name in $(steps_that_are running); do
        kill -0 "${step_pid[$name]}" 2>/dev/null || end_step "$name"
    done
}

# Ends the running steps: ten seconds to clean up, then by force.
stop_steps() {
    local name signal tries
    for signal in TERM KILL; do
        for name in $(steps_that_are running); do kill -$signal -- "-${step_pid[$name]}" 2>/dev/null || true; done
        for ((tries = 0; tries < 100; tries++)); do
            for name in $(steps_that_are running); do
                if kill -0 "${step_pid[$name]}" 2>/dev/null; then continue; fi
                step_state[$name]=stopped
                step_seconds[$name]=$((SECONDS - step_began[$name]))
            done
            [ -n "$(steps_that_are running)" ] || return 0
            sleep 0.1
        done
    done
}

print_table() {
    local name
    printf '\n%-24s %9s %8s  %s\n' step 'began at' seconds result
    for name in "${step_names[@]}"; do
        printf '%-24s %9s %8s  %s\n' "$name" "${step_began[$name]:--}" "${step_seconds[$name]:--}" "${step_state[$name]}"
    done
    printf '%-24s %9s %8s\n' total '' "$SECONDS"
}

interrupted() {
    stop_steps
    print_table
    rm -rf "$step_logs"
    exit 143
}

# The caller removes `step_logs`, the folder of the logs.
run_steps() {
    local name
    capacity=${CI_CPU:-$((100 * $(nproc)))}
    step_logs=$(mktemp -d)
    for name in "${step_names[@]}"; do step_log[$name]=$step_logs/$name; done
    trap interrupted INT TERM
    start_steps
    while [ -n "$(steps_that_are running)" ]; do
        sleep 0.2
        end_steps
        if [ -n "$failed_step" ]; then stop_steps; else start_steps; fi
    done
    trap - INT TERM
    print_table
    if [ -n "$failed_step" ]; then
        printf '\n%s: %s. The end of its log:\n' "$failed_step" "${step_state[$failed_step]}"
        tail -n 40 "${step_log[$failed_step]}"
        return 1
    fi
}
