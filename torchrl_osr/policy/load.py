"""Loading a policy from its file."""

from __future__ import annotations

from pathlib import Path

from torchrl_osr.policy.policy import SUFFIX, Policy
from torchrl_osr.policy.tensor_file import read_tensors


def load_policy(path: Path | str) -> Policy:
    """Load a policy that was saved or exported, on the CPU; nothing is unpickled.

    Args:
        path: a ``.safetensors`` file of :meth:`~torchrl_osr.policy.Policy.save` or
            ``torchrl-osr export``.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: safetensors is not installed.
        ValueError: the file is no policy, damaged, or of another version.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_osr import CQLLoss, load_policy
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> from torchrl_osr.policy import policy_from_loss
        >>> networks = tanh_gaussian_actor(3, 1), critic_ensemble(3, 1)
        >>> loss = CQLLoss(*networks)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     policy_from_loss(loss).save(f"{folder}/policy.safetensors")
        ...     policy = load_policy(f"{folder}/policy.safetensors")
        >>> policy.act(np.zeros(3)).shape
        (1,)
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise ValueError(
            f"{path} does not end in {SUFFIX}: give a file that Policy.save or "
            "`torchrl-osr export` wrote."
        )
    try:
        tensors, record = read_tensors(path)
        return Policy(record, tensors)
    except (KeyError, TypeError, ValueError) as error:
        why = f"no {error} in it" if isinstance(error, KeyError) else error
        raise ValueError(
            f"{path} cannot be read as a policy: {why}. Take a whole copy, or save it "
            "again."
        ) from error
