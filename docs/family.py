"""Write ``family.md`` from a test run: what was checked against what, how far off.

    pytest tests/objectives tests/imagination -o junit_family=xunit1 --junitxml=c.xml
    python docs/family.py c.xml

Tests note their largest deviation (the fixture ``check``) and the rows that critics
score; this script adds only what a loss is called, its equation and its command line.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree

PAGE = Path(__file__).parent / "family.md"
REST = "critic by critic and action by action, torch.distributions"
# Label of the checks: class and equation, configuration, what it is compared with.
FAMILY = {
    "Inverse dynamics": (
        "`InverseDynamicsLoss`, 4.2", "`inverse_dynamics=tanh_gaussian`",
        "density by the change of variables",
    ),
    "Inverse dynamics, conditional VAE": (
        "`InverseDynamicsLoss(loss_function=\"mse\")`, released code",
        "`inverse_dynamics=cvae`", "squared error and divergence written out",
    ),
    "OSR": ("`OSRLoss`, (11), 4.4", "`loss=osr`", REST),
    "OSR, official variant": (
        "`OSRLoss`, released code", "`loss=osr_official`", REST,
    ),
    "OSR-v": ("`OSRVLoss`, (8), 4.4", "`loss=osr_v`", REST),
    "OSR-v on the data's actions": (
        "`OSRVLoss`, (8) without the model", "`loss=osr_v_data`", REST,
    ),
    "OSR-10": ("`OSRLoss`, appendix D.4", "`loss=osr_10`", "`kl_divergence` of torch"),
    "CQL(H)": ("`OSRLoss`, CQL appendix F", "`loss=cql`", REST),
    "OSR, clean states": (
        "`OSRLoss`, (11) on D alone", "`loss=osr loss.recovery_states=clean`", REST,
    ),
    "CQL(H) and cloning": (
        "`OSRLoss`, CQL appendix F and -log pi", "`loss=cql_bc`", REST,
    ),
    "CQL(H) and noisy cloning": (
        "`OSRLoss`, CQL appendix F and -log pi", "`loss=cql_noisy_bc`", REST,
    ),
    "CQL(H) with its options": (
        "`OSRLoss`, CQL appendix F and CORL", "`loss=cql loss.with_lagrange=true ...`",
        REST,
    ),
    "SAC-N": ("`OSRLoss`, SAC-N", "`loss=sac_10`", REST),
    "EDAC": ("`EDACLoss`, EDAC", "`loss=edac_10`", "all pairs of gradients"),
    "TD3+BC": ("`TD3BCLoss`, TD3+BC (3) to (5)", "`loss=td3_bc`, `loss=rim`", REST),
    "ReBRAC": (
        "`ReBRACLoss`, released code", "`loss=rebrac`",
        "row by row and critic by critic",
    ),
    "IQL": (
        "`IQLLoss` on TorchRL's, IQL (5) to (7)", "`loss=iql`",
        "critic by critic, torch.distributions",
    ),
    "RORL": (
        "`RORLLoss`, released code", "`loss=rorl`",
        "draw by draw and critic by critic, torch.distributions",
    ),
    "Behaviour cloning": ("`BCLoss`", "`loss=bc`", "torch.distributions"),
    "Noisy behaviour cloning": (
        "`BCLoss(states=\"both\")`", "`loss=noisy_bc`", "torch.distributions",
    ),
    "Dynamics ensemble": (
        "`DynamicsLoss`, MOPO's code", "`loss=mopo`, `dynamics=ensemble`",
        "Gaussian by Gaussian, network by network",
    ),
    "SCAS": (
        "`SCASLoss`, SCAS's released code and print", "`loss=scas`",
        "critic by critic, row by row and network by network",
    ),
    "RAMBO": (
        "`ModelAdversary`, RAMBO's code", "`loss=rambo`",
        "row by row and network by network",
    ),
    "SDC": (
        "`SDCLoss`, our reading", "`loss=sdc`", "pair by pair and network by network",
    ),
    "Conditional VAE": (
        "`ConditionalVAELoss`, BCQ's code", "`loss=sdc`, `loss=romi`", "row by row",
    ),
    "Adversary": (
        "`Adversary`, RORL", "`perturbation=adversarial`", "a loop over the same draws",
    ),
    "State recovery alone": (
        "`StateRecoveryLoss`, (11)", "`recovery=osr`", "`kl_divergence` of torch",
    ),
    "Noisy cloning alone": (
        "`StateRecoveryLoss`, -log pi", "`recovery=noisy_bc`", "torch.distributions",
    ),
    "Discrete OSR": (
        "`DiscreteOSRLoss`, (11), 4.4", "`loss=discrete_osr`",
        "action by action, `torch.distributions.Categorical`",
    ),
    "Discrete CQL(H)": (
        "`DiscreteOSRLoss`, CQL (4)", "`loss=discrete_cql`",
        "action by action, `torch.distributions.Categorical`",
    ),
    "Discrete inverse dynamics": (
        "`InverseDynamicsLoss`, 4.2", "`inverse_dynamics=categorical`",
        "`torch.distributions.Categorical`",
    ),
}  # fmt: skip
HEAD = """# The family of losses

Every loss is compared with a restatement of its published formula that shares no code with the package: losses and gradients, in float64, on random networks and batches with the same random draws. The last column is the largest deviation over all those numbers, relative to the larger of 1 and the number itself. Critic rows are the state-action pairs (for discrete actions: states) that all critics together score for one row of a batch, with two critics and K = 10 where there is a K, ten critics for the ensembles and four for SCAS; the policy's own action and the target's are counted.

| loss | class, equation | configuration | critic rows | compared with | checks | largest deviation |
|---|---|---|---|---|---|---|
"""  # noqa: E501
TAIL = """
This page is written by a test run:

```bash
pytest tests/objectives tests/imagination -o junit_family=xunit1 --junitxml=c.xml
python docs/family.py c.xml
```

What a training run of each method gives is in `results/scoreboard/`.
"""


def read(path: Path) -> tuple[dict[str, list[float]], dict[str, int]]:
    """Return all deviations by label, and the critic rows."""
    deviations: dict[str, list[float]] = defaultdict(list)
    rows: dict[str, int] = {}
    # A file that the caller's own test run wrote.
    for element in ElementTree.parse(path).iter("property"):
        name = element.get("name")
        if name in ("check", "rows"):
            label, number = ast.literal_eval(element.get("value", ""))
            if name == "check":
                deviations[label].append(number)
            else:
                rows[label] = int(number)
    return deviations, rows


def main(path: Path) -> None:
    """Write the page."""
    deviations, rows = read(path)
    missing = FAMILY.keys() ^ deviations.keys()
    if missing:
        raise SystemExit(f"checks and table differ in {sorted(missing)}")
    lines = [
        f"| {label} | {equation} | {configuration} | {rows.get(label, '')} | {against} "
        f"| {len(deviations[label])} | {max(deviations[label]):.0e} |\n"
        for label, (equation, configuration, against) in FAMILY.items()
    ]
    PAGE.write_text(HEAD + "".join(lines) + TAIL)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
