#!/bin/sh
# States and searches of some systems, a little of each in turn; goes on where it was.
#     nice -n 19 sh results/recovery/run.sh walker2d halfcheetah
# Two of them, with different systems, take two cores. From the root of the checkout.
export OMP_NUM_THREADS=1 PYTHONPATH=.
: "${PYTHON:=python}"
folder=results/recovery
for walks in 16 32 48 64 80 96 112 128; do
    for system in "$@"; do
        $PYTHON -W ignore $folder/states.py "$system" --walks $walks
        $PYTHON -W ignore $folder/search.py "$system" --stages 1
    done
done
# The budget's curve: more and more for some of what is not saved, then for the rest.
for system in "$@"; do $PYTHON -W ignore $folder/search.py "$system" --stages 2 --every 8; done
for system in "$@"; do $PYTHON -W ignore $folder/search.py "$system" --stages 3 --every 8; done
for system in "$@"; do $PYTHON -W ignore $folder/search.py "$system" --stages 4 --every 8; done
for system in "$@"; do $PYTHON -W ignore $folder/search.py "$system" --stages 2; done
for system in "$@"; do $PYTHON -W ignore $folder/search.py "$system" --stages 3; done
