"""Figures are whole, or the ones before."""

from __future__ import annotations

import pytest

from torchrl_osr.evaluation.drawing import new_figure, save_figure


def test_a_figure_is_whole_or_the_one_before(tmp_path):
    path = tmp_path / "curve.png"
    path.write_bytes(b"the one before")
    figure = new_figure(2, 1)
    draw = figure.savefig

    def fail(file, **options):
        file.write(b"half a pict")
        assert path.read_bytes() == b"the one before"
        raise OSError(28, "the disk is full")

    figure.savefig = fail
    with pytest.raises(OSError, match="full"):
        save_figure(figure, path)
    assert [each.name for each in tmp_path.iterdir()] == ["curve.png"]
    assert path.read_bytes() == b"the one before"
    figure.savefig = draw
    save_figure(figure, path)
    assert [each.name for each in tmp_path.iterdir()] == ["curve.png"]
    assert path.read_bytes().startswith(b"\x89PNG")
