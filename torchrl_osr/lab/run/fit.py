"""Training on a log, as one function."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from datetime import datetime
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from torchrl_osr._files import write_atomically
from torchrl_osr.lab.run import CONF
from torchrl_osr.lab.run.folder import open_run
from torchrl_osr.lab.run.load import load_run_policy
from torchrl_osr.lab.run.schema import register
from torchrl_osr.lab.run.train import train
from torchrl_osr.policy import Policy


@torch.random.fork_rng(devices=[])
def fit(
    log: Mapping[str, Any] | Path | str, folder: Path | str, *overrides: str
) -> Policy:
    """Train a policy on a log, as ``torchrl-osr train env=none data=file`` does.

    The same call continues a run that was stopped, and returns a finished one's policy.
    In a notebook, ``logging.basicConfig(level="INFO")`` shows its progress.

    Args:
        log: file of a log, or its columns by their usual names, such as a data frame.
            Columns are kept in the folder.
        folder: of the run.
        overrides: settings, as on the command line: ``"loss=td3_bc"``.

    Examples:
        >>> from tempfile import mkdtemp
        >>> import numpy as np
        >>> from torchrl_osr.lab import fit
        >>> rng = np.random.default_rng(0)
        >>> log = {"observation": rng.normal(size=(300, 2)), "reward": rng.random(300)}
        >>> log |= {"action": rng.random((300, 1)), "terminated": np.zeros(300)}
        >>> log["episode"] = np.arange(300) // 100
        >>> policy = fit(log, mkdtemp() + "/arm", "loss=bc", "trainer.steps=2")
        <BLANKLINE>
        log-arm file, in /.../arm: the policy is trained, and was never played
        >>> policy.act(np.zeros(2)).shape
        (1,)
    """
    register()
    folder = Path(folder)
    if hasattr(log, "items"):  # a mapping or a data frame
        columns: Any = {str(name): np.asarray(column) for name, column in log.items()}
        columns.pop("file", None)  # no part of a log; np.savez has an argument "file"
        for name, column in columns.items():
            if column.dtype.kind == "O":  # text, or lists of one length
                columns[name] = plain = np.asarray(column.tolist())
                if plain.dtype.kind == "O":  # times, or numbers and None (NaN)
                    timed = any(isinstance(each, datetime) for each in plain.flat)
                    columns[name] = plain.astype(str if timed else float)
        np.savez(content := BytesIO(), **columns)
        digest = hashlib.sha256(content.getvalue()).hexdigest()
        log = folder / "columns" / digest[:8] / f"{folder.name}.npz"
        log.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(log, content.getvalue())
        del columns, content  # as large as the log
    place = str(log).replace("'", "\\'")
    given = ["env=none", "data=file", f"data.path='{place}'", *overrides]
    with initialize_config_dir(CONF, version_base="1.3"):
        cfg = compose("train", given, return_hydra_config=True)
    settings = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    num_threads = torch.get_num_threads()
    try:
        with open_run(settings, folder, cfg.hydra) as run:
            train(run)
    finally:
        torch.set_num_threads(num_threads)
    return load_run_policy(folder, settings.trust)
