# Sourced by the checks: `step NAME` begins a step, and the end of the shell prints how long each took and which tests were slow.
# target/ci-times.txt keeps both, also of checks that fail.

times=target/ci-times.txt
mkdir -p target
rm -f "$times" target/test-times.txt
step_name=
checks_started=$(date +%s)
step_started=$checks_started

end_step() {
    now=$(date +%s)
    [ -z "$step_name" ] || printf '%6d s  %s\n' $((now - step_started)) "$step_name" >>"$times"
    step_started=$now
}

step() {
    end_step
    step_name=$1
    echo "== $step_name ($(date -u +%H:%M:%S))"
}

sum_up() {
    code=$?
    end_step
    {
        printf '%6d s  in all\n' $(($(date +%s) - checks_started))
        if [ -f target/test-times.txt ]; then
            printf '\nslowest tests, in seconds:\n'
            head -n 20 target/test-times.txt
        fi
    } >>"$times"
    if [ $code = 0 ]; then echo "== done"; else echo "== FAILED: $step_name"; fi
    cat "$times"
    exit $code
}
trap sum_up EXIT
