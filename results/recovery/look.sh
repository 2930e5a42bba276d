# The looks of step 5, Walker2d's and Hopper's: all runs of one first, then all of them
# from the held-out half, once.
set -e
from() {
    half=$1 data=$2
    shift 2
    python results/recovery/imagination.py outputs/look --half "$half" \
        --data "$data" "$@"
}
walker2d() {
    from "$1" walker2d-medium-expert --seeds 300 301 302 303 304 \
        --arms "disturbed starts" "undisturbed starts" "noisy cloning"
    from "$1" walker2d-medium-expert --seeds 300 303 --arms base
    from "$1" walker2d-medium-replay --seeds 300 301 \
        --arms "disturbed starts" "noisy cloning"
}
hopper() {
    from "$1" hopper-medium-expert --seeds 300 301 302 303 304 \
        --arms "disturbed starts" "undisturbed starts" "noisy cloning"
    from "$1" hopper-medium-expert --seeds 300 303 --arms base
}
walker2d public
walker2d held-out
hopper public
hopper held-out
python results/recovery/imagination.py outputs/look --pack imagination-look
