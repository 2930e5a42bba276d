# The looks at the held-out half, as they were taken; what is there is not done again.
set -e
labels() {
    for system in pointmaze-medium walker2d; do
        wide=$([ $system = walker2d ] || echo noisy:.3)
        python results/recovery/cloning.py $system --half held-out --episodes 20 \
            --updates 8000 --seeds $(seq 100 119) --arms cloning noisy:.1 $wide \
            osr:.1 osr-clean:.1 corrective:.3:1 corrective-row:.3:1 \
            corrective-flipped:.3:1 witnesses expert:.1
    done
}
ways() {
    set -- walker2d --half held-out --study ways --updates 8000 --seeds $(seq 120 139)
    python results/recovery/cloning.py "$@" --episodes 20 \
        --arms noisy:.1 ways:0:565 ways-expert:0:565
    python results/recovery/cloning.py "$@" --episodes 100 --arms noisy:.1
}
ahead() {
    set -- --half held-out --plans 20v
    python results/recovery/look_ahead.py "$@" --model large --seeds 200 201 202 \
        --arms base look-ahead shuffled
    python results/recovery/look_ahead.py "$@" --model large --seeds 200 \
        --arms random always nearest simulator both
    python results/recovery/look_ahead.py "$@" --model pushed --seeds 200 \
        --arms look-ahead
    python results/recovery/look_ahead.py "$@" --model large --seeds 200 \
        --arms base look-ahead both --groups easy contested
}
from() {
    half=$1 data=$2
    shift 2
    python results/recovery/imagination.py "$folder" --half "$half" \
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
chosen() {
    set -- "$folder" --half held-out --data "$@"
    python results/recovery/choice.py "$@" \
        --arms one critics "models 20" "shuffled 20"
    python results/recovery/choice.py "$@" --groups easy \
        --arms one critics "models 20"
    python results/recovery/choice.py "$@" --groups contested --arms one "models 20"
}
choice() {
    for first in 310 315; do
        seeds=$(seq $first $((first + 4)))
        from held-out walker2d-medium-expert --seeds $seeds --arms "disturbed starts"
        chosen walker2d-medium-expert --seeds $seeds
    done
    seeds=$(seq 310 314)
    from held-out hopper-medium-expert --seeds $seeds --arms "disturbed starts"
    chosen hopper-medium-expert --seeds $seeds
    python results/recovery/choice.py "$folder" --half held-out \
        --seeds $(seq 310 319) --arms "models 20"
    from held-out walker2d-medium-expert --seeds $seeds --arms "noisy cloning"
    python results/recovery/choice.py "$folder" --half held-out --seeds $seeds \
        --policies "noisy cloning" --arms one "models 20"
}
folder=outputs/look
labels
ways
ahead
walker2d public
walker2d held-out
hopper public
hopper held-out
python results/recovery/imagination.py outputs/look --pack imagination-look
folder=outputs/choice
choice
python results/recovery/imagination.py "$folder" --pack imagination-choice
