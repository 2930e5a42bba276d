# The look at a choice: trains what it takes, then plays the held-out half once.
set -eu
look() { python results/recovery/choice.py "$1" --half held-out "${@:2}"; }
