"""CQL's options, SAC-N and EDAC against plain restatements of the published formulas.

"Conservative Q-Learning" (Kumar et al. 2020, https://arxiv.org/abs/2006.04779) and its
common implementations for the options, "Uncertainty-Based Offline Reinforcement
Learning with Diversified Q-Ensemble" (An et al. 2021,
https://arxiv.org/abs/2110.01548) for SAC-N and EDAC.
"""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal, TransformedDistribution
from torch.distributions.transforms import AffineTransform, TanhTransform
from torchrl.objectives import SoftUpdate

from torchrl_osr import OSRLoss
from torchrl_osr.functional import gradient_diversity, lagrange_terms

GAMMA, K, ALPHA, MIN_Q_WEIGHT, TARGET_SCALE, LOG_PRIME = 0.875, 3, 0.3, 2.5, 0.8, 0.4
DEFAULTS = {
    "min_q_weight": MIN_Q_WEIGHT,
    "temperature": 1.0,
    "importance_sample": True,
    "clip_diff_min": -math.inf,
    "clip_diff_max": math.inf,
    "max_q_backup": False,
    "deterministic_backup": True,
    "with_lagrange": False,
    "lagrange_thresh": 0.0,
    "diversity_weight": 0.0,
}
CASES = {
    "cql": {},
    "temperature": {"temperature": 1.7},
    "without importance sampling": {"importance_sample": False, "temperature": 0.6},
    "clipped": {"clip_diff_min": 1.5, "clip_diff_max": 3.0},
    "max backup": {"max_q_backup": True},
    "entropy in the backup": {"deterministic_backup": False},
    "both backups": {"max_q_backup": True, "deterministic_backup": False},
    "lagrange": {"with_lagrange": True, "lagrange_thresh": 2.0},
    "clipped lagrange": {
        "with_lagrange": True,
        "lagrange_thresh": -1.0,
        "clip_diff_max": 3.0,
    },
    "sac-n": {"min_q_weight": 0.0, "deterministic_backup": False},
    "edac": {
        "min_q_weight": 0.0,
        "deterministic_backup": False,
        "diversity_weight": 0.75,
    },
    "everything": {
        "temperature": 1.7,
        "clip_diff_max": 4.0,
        "max_q_backup": True,
        "deterministic_backup": False,
        "with_lagrange": True,
        "lagrange_thresh": 1.0,
        "diversity_weight": 0.75,
    },
}
CRITIC_LOSSES = ["loss_qvalue", "loss_cql", "loss_alpha_prime", "loss_diversity"]


def build(networks, **options) -> OSRLoss:
    loss = OSRLoss(
        networks.actor,
        networks.critics,
        recovery_weight=0.0,
        num_random=K,
        alpha_init=ALPHA,
        **options,
    ).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    loss.target_qvalue_network_params.apply_(lambda tensor: tensor.mul_(TARGET_SCALE))
    # The constructor takes the logarithm in float32.
    loss.log_alpha.data.fill_(math.log(ALPHA))
    if loss.with_lagrange:
        loss.log_alpha_prime.data.fill_(LOG_PRIME)
    return loss


def restated(networks, batch, seed: int, bounds, **options) -> dict[str, Tensor]:
    """The critics' losses, one critic and one action at a time; no torchrl_osr."""
    o = DEFAULTS | options
    low, high = bounds
    s, a = batch["observation"], batch["action"]
    terminated = batch["next", "terminated"]
    s_next = torch.where(terminated, s, batch["next", "observation"])
    critics = [critic.module for critic in networks.critics]
    targets = copy.deepcopy(critics)
    for target in targets:
        for parameter in target.parameters():
            parameter.data.mul_(TARGET_SCALE)

    def policy(state):
        _, loc, scale = networks.actor[0](state)
        half = (high - low) / 2
        squash = [TanhTransform(cache_size=1), AffineTransform(low + half, half)]
        base = Normal(loc.detach(), scale.detach())
        return Independent(base, 1), TransformedDistribution(
            Independent(base, 1), squash
        )

    def act(state, noise):
        base, squashed = policy(state)
        action = base.mean + base.stddev * noise
        for transform in squashed.transforms:
            action = transform(action)
        return action, squashed.log_prob(action)

    # The draws, in the order in which the loss makes them.
    torch.manual_seed(seed)
    like = {"dtype": torch.float64}
    torch.randn(1, *a.shape, **like)  # the actor's own
    if o["min_q_weight"]:
        uniform = torch.rand(K, *a.shape, **like)
        noise = torch.randn(K, 2, *a.shape, **like)
    next_noise = torch.randn(*((K,) if o["max_q_backup"] else (1,)), *a.shape, **like)

    with torch.no_grad():
        values, densities = [], []
        for each in next_noise:
            action, log_prob = act(s_next, each)
            pair = [q(s_next, action).squeeze(-1) for q in targets]
            values.append(torch.stack(pair).amin(0))
            densities.append(log_prob)
        best = torch.stack(values).argmax(0, keepdim=True)
        value = torch.stack(values).gather(0, best).squeeze(0)
        if not o["deterministic_backup"]:
            value = value - ALPHA * torch.stack(densities).gather(0, best).squeeze(0)
        alive = 1 - terminated.squeeze(-1).double()
        target = batch["next", "reward"].squeeze(-1) + GAMMA * alive * value
    losses = {
        "loss_qvalue": sum(
            (q(s, a).squeeze(-1) - target).pow(2).mean() for q in critics
        )
    }
    if o["min_q_weight"]:
        box = -(high - low).log().sum()
        proposals = [(low + (high - low) * u, box) for u in uniform]
        for each in noise:
            proposals += [act(s, each[0]), act(s_next, each[1])]
        gaps = []
        for q in critics:
            data = q(s, a).squeeze(-1)
            terms = [
                q(s, x).squeeze(-1) - p * o["importance_sample"] for x, p in proposals
            ]
            if not o["importance_sample"]:
                terms.append(data)
            scaled = [(term / o["temperature"]).exp() for term in terms]
            gap = o["temperature"] * sum(scaled).log() - data
            gaps.append(gap.clamp(o["clip_diff_min"], o["clip_diff_max"]).mean())
        multiplier = 1.0
        if o["with_lagrange"]:
            multiplier = math.exp(LOG_PRIME)
            gaps = [gap - o["lagrange_thresh"] for gap in gaps]
            # CORL: half the sum over two critics, both sides of one product.
            log_prime = torch.tensor(LOG_PRIME, dtype=torch.float64).requires_grad_()
            slack = sum(gap.detach() for gap in gaps) / len(gaps)
            losses["loss_alpha_prime"] = -o["min_q_weight"] * log_prime.exp() * slack
            losses["log_prime"] = log_prime
        losses["loss_cql"] = o["min_q_weight"] * multiplier * sum(gaps)
    if o["diversity_weight"]:
        leaf = a.clone().requires_grad_()
        units = []
        for q in critics:
            (g,) = torch.autograd.grad(q(s, leaf).sum(), leaf, create_graph=True)
            units.append(g / g.norm(dim=-1, keepdim=True))
        pairs = [
            (units[i] * units[j]).sum(-1)
            for i in range(len(units))
            for j in range(len(units))
            if i != j
        ]
        similarity = sum(pairs).mean() / (len(critics) - 1)
        losses["loss_diversity"] = o["diversity_weight"] * similarity
    return losses


BOX = (torch.tensor([-1.0, -0.5]).double(), torch.tensor([2.0, 1.5]).double())
UNIT = (-torch.ones(2).double(), torch.ones(2).double())


# Critics with ReLUs are plain MLPs, which have a path of their own on a CPU.
WAYS = {
    "vmap": (UNIT, {"num_critics": 2}, False),
    "loop": (BOX, {"num_critics": 4}, True),
    "plain": (UNIT, {"num_critics": 4, "critic_activation": nn.ReLU}, False),
    "plain box": (BOX, {"num_critics": 2, "critic_activation": nn.ReLU}, False),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("case", CASES)
def test_critic_losses_and_gradients_equal_the_restatement(
    make_networks, make_batch, check, case, way
) -> None:
    bounds, critics, deactivate_vmap = WAYS[way]
    low, high = bounds
    networks = make_networks(low=low, high=high, **critics)
    batch, options = make_batch(10), DEFAULTS | CASES[case]
    reference = copy.deepcopy(networks)
    expected = restated(reference, batch, 5, bounds, **options)
    loss = build(networks, deactivate_vmap=deactivate_vmap, **options)
    torch.manual_seed(5)
    out = loss(batch)
    names = [name for name in CRITIC_LOSSES if name in loss.out_keys]
    log_prime = expected.pop("log_prime", None)
    assert set(names) == set(expected)
    got, wanted = [out[name] for name in names], [expected[name] for name in names]

    sum(out[name] for name in names).backward()
    sum(expected.values()).backward()
    for index, params in enumerate(loss.qvalue_network_params.values(True, True)):
        got.append(params.grad)
        each = [list(q.parameters())[index].grad for q in reference.critics]
        wanted.append(torch.stack(each))
    if log_prime is not None:
        got.append(loss.log_alpha_prime.grad)
        wanted.append(log_prime.grad)
    names = {"sac-n": "SAC-N", "edac": "EDAC"}
    check(names.get(case, "CQL(H) with its options"), got, wanted, tolerance=1e-9)


def test_gap_that_is_clipped_sends_no_gradient(make_networks, make_batch) -> None:
    loss = build(make_networks(), clip_diff_min=-1.0, clip_diff_max=-0.5)
    loss(make_batch(10))["loss_cql"].backward()
    for gradient in (p.grad for p in loss.qvalue_network_params.values(True, True)):
        assert gradient.abs().max() == 0


@pytest.mark.parametrize(("threshold", "rises"), [(-100.0, True), (100.0, False)])
def test_multiplier_rises_while_the_gap_is_too_large(
    make_networks, make_batch, threshold, rises
) -> None:
    loss = build(make_networks(), with_lagrange=True, lagrange_thresh=threshold)
    optimizer = torch.optim.SGD([loss.log_alpha_prime], lr=1e-4)
    out = loss(make_batch(10))
    sum(v for k, v in out.items() if k.startswith("loss_")).backward()
    optimizer.step()
    assert (loss.log_alpha_prime.item() > LOG_PRIME) == rises


def test_lagrange_terms_by_hand() -> None:
    gap = torch.tensor([1.0, 4.0], requires_grad=True)
    log_multiplier = torch.tensor(math.log(3.0), requires_grad=True)
    critic, dual = lagrange_terms(gap, log_multiplier, 2.0)
    torch.testing.assert_close(critic, torch.tensor([-3.0, 6.0]))
    torch.testing.assert_close(dual, torch.tensor([3.0, -6.0]))
    (critic.sum() + dual.sum()).backward()
    torch.testing.assert_close(gap.grad, torch.tensor([3.0, 3.0]))
    torch.testing.assert_close(log_multiplier.grad, torch.tensor(-3.0))


# Three critics: (0, 90, 180) degrees have the pairs 0, 0, -1 twice each.
@pytest.mark.parametrize(
    ("gradients", "expected"),
    [
        ([[2.0, 0.0], [0.5, 0.0]], 2.0),
        ([[2.0, 0.0], [-1.0, 0.0]], -2.0),
        ([[1.0, 0.0], [0.0, 3.0], [-2.0, 0.0]], -1.0),
        ([[1.0, 1.0], [1.0, 1.0], [1.0, 1.0]], 3.0),
    ],
)
def test_diversity_by_hand(gradients, expected) -> None:
    value = gradient_diversity(torch.tensor(gradients).unsqueeze(1))
    torch.testing.assert_close(value, torch.tensor([expected]))


def test_diversity_of_a_dead_critic_is_finite() -> None:
    gradients = torch.zeros(2, 1, 3, requires_grad=True)
    gradient_diversity(gradients).sum().backward()
    assert gradients.grad.isfinite().all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"with_lagrange": True, "min_q_weight": 0.0}, "needs min_q_weight above 0"),
        ({"clip_diff_min": 2.0, "clip_diff_max": 1.0}, "below clip_diff_max.*2.0.*1.0"),
        ({"diversity_weight": -1.0}, "diversity_weight must be at least 0, got -1.0"),
    ],
)
def test_options_that_contradict_each_other_are_refused(
    make_networks, options, message
) -> None:
    with pytest.raises(ValueError, match=message):
        build(make_networks(), **options)


def test_diversity_of_one_critic_is_refused(make_networks) -> None:
    with pytest.raises(ValueError, match="at least 2"):
        build(make_networks(num_critics=1), diversity_weight=1.0)
