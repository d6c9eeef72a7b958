#!/usr/bin/env bash
# Search at random for examples that fail: rounds of the property tests, each with a seed of its own.
#
# SEED=n repeats round n, MINUTES=m searches for m minutes (30), TESTS=path takes a part of the tests.
set -euo pipefail
cd "$(dirname "$0")/.."

round() {
    printf 'fuzz: seed %s\n' "$1"
    .venv/bin/python -m pytest -q -m "hypothesis and not slow" "${TESTS:-tests}" \
        --hypothesis-profile=fuzz --hypothesis-seed="$1" || {
        printf 'fuzz: failed; the same examples again: make fuzz SEED=%s\n' "$1" >&2
        exit 1
    }
}

if [[ -n ${SEED:-} ]]; then
    round "$SEED"
    exit
fi
end=$((SECONDS + 60 * ${MINUTES:-30}))
while ((SECONDS < end)); do
    round $((RANDOM * 32768 + RANDOM))
done
