#!/bin/sh
# States and searches of some systems, a little of each in turn; goes on where it was.
#     nice -n 19 sh results/recovery/run.sh walker2d halfcheetah
# Two of them, with different systems, take two cores. From the root of the checkout.
export OMP_NUM_THREADS=1 PYTHONPATH=.
: "${PYTHON:=python}"
folder=results/recovery
saved() { cat $folder/parts/"$1"/search-*.jsonl 2>/dev/null | grep -c '"saved":true'; }
# Walks until 320 states are saved, of which a few are no witness on another machine.
for walks in $(seq 16 16 640); do
    for system in "$@"; do
        [ "$(saved "$system")" -ge 320 ] && continue
        $PYTHON -W ignore $folder/states.py "$system" --walks "$walks"
        $PYTHON -W ignore $folder/search.py "$system" --stages 1
    done
done
# The budget's curve: more and more for some of what is not saved.
for system in "$@"; do $PYTHON -W ignore $folder/search.py "$system" --stages 2 --every 8; done
for system in "$@"; do $PYTHON -W ignore $folder/search.py "$system" --stages 3 --every 8; done
for system in "$@"; do $PYTHON -W ignore $folder/search.py "$system" --stages 4 --every 8; done
