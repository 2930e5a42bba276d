"""Loading a policy, from its file or from the run that trained it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_osr.policy.policy import SUFFIX, Policy
from torchrl_osr.policy.tensor_file import read_tensors


def load_policy(path: Path | str, *, trust: Sequence[str] = ()) -> Policy:
    """Policy of a file or of a run, on the CPU; nothing is unpickled.

    Args:
        path: what :meth:`~torchrl_osr.Policy.save` wrote, which needs safetensors
            only; a run's folder, for its last checkpoint, the one that tables show; or
            a checkpoint's file in it, ``checkpoint/policy/best.torchrl`` for the best
            evaluation. A run needs ``torchrl-osr[train]``, but no environment.

    Keyword Args:
        trust: modules of your own whose losses and networks a run may name, see
            docs/extend.md. Default: none.

    Raises:
        FileNotFoundError: there is nothing, no run, or no checkpoint yet.
        ImportError: a package is missing, naming the extra that has it.
        ValueError: the file is no policy, is damaged or of another version of the
            format, or the run's networks are none of this package's.
        CheckpointError: the checkpoint is damaged, or does not fit its run.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_osr import OSRLoss, load_policy
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> from torchrl_osr.policy import policy_from_loss
        >>> networks = tanh_gaussian_actor(3, 1), critic_ensemble(3, 1)
        >>> loss = OSRLoss(*networks, recovery_weight=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     policy_from_loss(loss).save(f"{folder}/policy.safetensors")
        ...     policy = load_policy(f"{folder}/policy.safetensors")
        >>> policy.act(np.zeros(3)).shape
        (1,)
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        return _policy_of_run(path, trust)
    try:
        tensors, record = read_tensors(path)
        return Policy(record, tensors)
    except (KeyError, TypeError, ValueError) as error:
        why = f"no {error} in it" if isinstance(error, KeyError) else error
        raise ValueError(
            f"{path} cannot be read as a policy: {why}. Take a whole copy, or save it "
            "again."
        ) from error


def _policy_of_run(path: Path, trust: Sequence[str]) -> Policy:
    try:
        from torchrl_osr.policy.from_run import policy_from_run
    except ImportError as error:
        raise ImportError(
            f"a run's checkpoint needs {error.name!r}: pip install torchrl-osr[train], "
            "or load a file that Policy.save wrote."
        ) from error
    return policy_from_run(path, trust)
