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
        $PYTHON -W ignore $folder/search.py "$system"
    done
done
# The budget's curve: all stages for a sample of what is not saved.
for system in "$@"; do $PYTHON -W ignore $folder/search.py "$system" --deeper 30; done
