"""A module's graph in one file, for ONNX Runtime or for torch alone."""

from __future__ import annotations

import io
import json
import logging
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_osr._extras import needed_by
from torchrl_osr._files import RECORD, write_atomically

SUFFIXES = (".onnx", ".pt2")


def write_graph(
    path: Path,
    module: nn.Module,
    inputs: Mapping[str, Tensor],
    output: str,
    record: Mapping[str, Any],
) -> None:
    """Write the graph of a module, for any number of rows.

    Args:
        path: its suffix decides, one of :data:`SUFFIXES`.
        module: has one output.
        inputs: example of each input, ``[B, ...]``, by name.
        output: name of the output.
        record: JSON-compatible, kept in ONNX's metadata or as an extra file.

    Raises:
        ImportError: ONNX needs onnx and onnxscript.
        OSError: the file cannot be written.
        ValueError: ``path`` has another suffix.
    """
    if path.suffix not in SUFFIXES:
        raise ValueError(f"the path must end in {' or '.join(SUFFIXES)}, got {path}.")
    text, given = json.dumps(record), dict[str, Any](args=(), kwargs=dict(inputs))
    rows = torch.export.Dim("batch")
    given["dynamic_shapes"] = {name: {0: rows} for name in inputs}
    if path.suffix == ".pt2":
        file = io.BytesIO()
        program = torch.export.export(module, **given)
        torch.export.save(program, file, extra_files={RECORD: text})
        write_atomically(path, file.getvalue())
        return
    with needed_by("ONNX needs", "export"):
        import onnxscript  # noqa: F401
    # torch 2.13's exporter calls what torch deprecates, and misses torchvision.
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            given |= {"input_names": list(inputs), "output_names": [output]}
            onnx = torch.onnx.export(module, **given, dynamo=True, verbose=False)
    finally:
        log.setLevel(level)
    assert onnx is not None
    onnx.model.metadata_props[RECORD] = text
    write_atomically(path, onnx.model_proto.SerializeToString())
