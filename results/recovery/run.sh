#!/bin/sh
# States and searches of some systems, a little of each in turn; goes on where it was.
#     nice -n 19 sh results/recovery/run.sh walker2d halfcheetah
# Two of them, with different systems, take two cores. From the root of the checkout.
export OMP_NUM_THREADS=1 PYTHONPATH=.
: "${PYTHON:=python}"
for walks in 16 32 48 64 80 96 112 128; do
    for system in "$@"; do
        $PYTHON -W ignore results/recovery/states.py "$system" --walks $walks
        $PYTHON -W ignore results/recovery/search.py "$system" --stages 2
        # The budget's curve: an eighth of what is not saved yet.
        $PYTHON -W ignore results/recovery/search.py "$system" --stages 4 --every 8
    done
done
