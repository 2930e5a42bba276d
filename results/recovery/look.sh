# The look of step 5: all runs first, then all of them from the held-out half, once.
set -e
look() {
    python results/recovery/imagination.py outputs/look --half "$1" \
        --arms "disturbed starts" "undisturbed starts" "noisy cloning" \
        --seeds 300 301 302 303 304
    python results/recovery/imagination.py outputs/look --half "$1" \
        --arms base --seeds 300 303
    python results/recovery/imagination.py outputs/look --half "$1" \
        --data walker2d-medium-replay --arms "disturbed starts" "noisy cloning" \
        --seeds 300 301
}
look public
look held-out
python results/recovery/imagination.py outputs/look --pack imagination-look
