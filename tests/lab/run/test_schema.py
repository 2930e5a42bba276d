"""Every configuration composes, and whatever is mistyped stops by name."""

from __future__ import annotations

import inspect
from dataclasses import MISSING, fields, is_dataclass

import pytest
from composed import CONF, composed
from hydra.errors import ConfigCompositionException
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf, ValidationError

from torchrl_osr import InverseDynamicsLoss, OSRLoss, objectives
from torchrl_osr.lab.data.behavior import load_behavior_card
from torchrl_osr.lab.data.environment import MAZE_IDS
from torchrl_osr.lab.data.mazes import MAZE_SOURCES
from torchrl_osr.lab.data.rollout import BEHAVIORS
from torchrl_osr.lab.data.sources import RECORDED
from torchrl_osr.lab.losses import Adversary
from torchrl_osr.lab.run import schema as config
from torchrl_osr.lab.run.run_config import read_run
from torchrl_osr.lab.run.schema import schema_of

GROUPS = ["env", "data", "inverse_dynamics", "dynamics", "loss", "recovery", "logger"]
GROUPS += ["perturbation", "preset"]
OBJECTIVES = sorted(config.CHOSEN)
PARTS = ("actor", "qvalue", "value", "inverse_dynamics", "dynamics", "transition")
NETWORKS = {f"{part}_network" for part in PARTS}
NO_OPTIONS = {"action_spec", "gamma"}  # an object of Python, and what is refused


def train(*overrides: str):
    return composed("train", *overrides)


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize(
    "override",
    [
        *(f"{group}={name}" for group in GROUPS for name in options(group)),
        "+inverse_dynamics.network.low=-2.0",
    ],
)
def test_every_option_composes_and_its_run_can_be_read(override, tmp_path):
    cfg = train(override)
    assert not OmegaConf.missing_keys(cfg)
    assert isinstance(OmegaConf.to_object(cfg), config.TrainConfig)
    OmegaConf.save(cfg, tmp_path / "config.yaml", resolve=True)
    again = read_run(tmp_path / "config.yaml")
    assert again == OmegaConf.load(tmp_path / "config.yaml")


@pytest.mark.parametrize("name", options("experiment"))
def test_every_experiment_composes_and_sweeps_over_values_that_compose(name):
    raw = OmegaConf.load(CONF / "experiment" / f"{name}.yaml")
    assert not OmegaConf.missing_keys(train(f"+experiment={name}"))
    for key, values in raw.hydra.sweeper.params.items():
        overrides = [f"{key}={value}" for value in str(values).split(",")]
        found = {str(train(f"+experiment={name}", each)) for each in overrides}
        assert len(found) == len(overrides)


def test_groups_name_what_the_package_has():
    assert options("data") == sorted([*BEHAVIORS, *MAZE_SOURCES, *RECORDED])
    assert options("env") == sorted([*load_behavior_card(), *MAZE_IDS])
    for name, env_id in MAZE_IDS.items():
        env = train(f"env={name}").env
        assert (env.name, env.id) == (name, env_id)
    for name, entry in load_behavior_card().items():
        env = train(f"env={name}").env
        assert (env.name, env.id) == (name, entry["env"])


def test_an_id_alone_is_enough():
    assert train("env.id=Pendulum-v1").env.name == "Pendulum-v1"
    assert train("env.id=robots:ns/Arm-v0").env.name == "ns-Arm-v0"
    assert train("env.id=Walker2d-v5").env.name == "walker2d"


def test_presets_reach_the_values_and_the_command_line_wins():
    assert train("preset=paper").trainer.steps == 1_000_000
    cfg = train("preset=paper", "trainer.steps=7", "data=expert")
    assert cfg.trainer.steps == 7
    assert cfg.trainer.batch_size == 256
    assert "expert" in cfg.data.values()


@pytest.mark.parametrize(("env", "weight"), [("walker2d", 20), ("halfcheetah", 100)])
def test_quick_preset_knows_data_of_an_expert(env, weight):
    cfg = train(f"env={env}", "data=medium-expert")
    assert (cfg.loss.min_q_weight, cfg.optim.actor_lr) == (weight, 3e-4)
    here = ["data=medium-expert", "optim.actor_lr=1e-3", "min_q_weight=7"]
    chosen = train(f"env={env}", *here)
    assert (chosen.loss.min_q_weight, chosen.optim.actor_lr) == (7, 1e-3)
    for other in (["data=medium-replay"], ["data=medium-expert", "preset=paper"]):
        assert train(f"env={env}", *other).loss.min_q_weight == 5
    # Losses without the term have no use for it.
    assert train(f"env={env}", "data=medium-expert", "loss=mopo").loss.min_q_weight == 0


# -- the schemas of the losses, derived from their signatures ----------------------


def keyword_parameters(name: str) -> dict[str, inspect.Parameter]:
    """What a user can give to a class besides networks, read from its signature."""
    target = getattr(objectives, name)
    found = dict(inspect.signature(target).parameters)
    for each in target.__mro__[1:]:
        if not found.pop("options", None):
            break
        found = inspect.signature(each).parameters | found
    left_out = NETWORKS | NO_OPTIONS
    return {key: each for key, each in found.items() if key not in left_out}


@pytest.mark.parametrize("name", OBJECTIVES)
def test_schema_has_the_names_and_defaults_of_the_signature(name):
    schema = schema_of(getattr(objectives, name))
    defaults = {field.name: field.default for field in fields(schema)}
    assert get_class(defaults.pop("_target_")) is getattr(objectives, name)
    parameters = keyword_parameters(name)
    assert len(parameters) > 3
    assert defaults == {key: each.default for key, each in parameters.items()}
    # OmegaConf takes every default for a value of its field's type, and keeps it.
    structured = OmegaConf.structured(schema)
    assert {key: structured[key] for key in defaults} == defaults


WRONG = {"float": "many", "int": 1.5, "bool": "perhaps"}


@pytest.mark.parametrize("name", OBJECTIVES)
def test_schema_has_the_types_of_the_signature(name):
    structured = OmegaConf.structured(schema_of(getattr(objectives, name)))
    for key, parameter in keyword_parameters(name).items():
        # Annotations are strings: "float", "int | None", "Literal['a', 'b']", ...
        parts = {part.strip() for part in parameter.annotation.split("|")}
        wrong = [WRONG[part] for part in parts & WRONG.keys()]
        if any(part.startswith(("Literal", "States")) for part in parts):
            structured[key], wrong = "text", [[1]]
        if "None" in parts:
            structured[key] = None
        else:
            wrong.append(None)
        assert wrong, key
        for value in wrong:
            with pytest.raises(ValidationError, match=key):
                structured[key] = value


def test_types_of_unions_and_literals():
    types = {field.name: field.type for field in fields(schema_of(OSRLoss))}
    assert types["recovery_weight"] is float
    assert types["recovery_states"] is types["recovery_direction"] is str
    assert types["fixed_alpha"] is bool
    assert types["chunk_size"] == int | None
    assert types["reduction"] == str | None
    assert types["use_prioritized_weights"] == bool | str
    assert types["target_entropy"] == float | str | int


MISTYPED = [
    ("trainer.steps=many", "many"),
    ("seed=first", "first"),
    ("network.num_cells=[wide]", "wide"),
    ("perturbation.stdd=1", "stdd"),
    ("inverse_dynamics.loss.latent_wieght=1", "latent_wieght"),
    ("loss.recovery_wieght=1", "wieght"),
    ("loss.fixed_alpha=perhaps", "perhaps"),
    ("loss.target_entropy=[1]", "target_entropy"),
]


@pytest.mark.parametrize(("override", "named"), MISTYPED)
def test_mistyped_key_or_type_stops_by_name(override, named):
    with pytest.raises(ConfigCompositionException) as error:
        train(override)
    assert named in f"{error.value} {error.value.__cause__}"


def changed(cfg) -> dict:
    """The options of a composed loss that are not its class's defaults."""
    container = OmegaConf.to_container(cfg, resolve=True)
    target = get_class(container.pop("_target_"))
    parameters = keyword_parameters(target.__name__)
    assert container.keys() == parameters.keys()
    return {k: v for k, v in container.items() if v != parameters[k].default}


CQL = {"recovery_weight": 0.0, "actor_states": "clean"}
OSR_10 = {"min_q_weight": 0.0, "deterministic_backup": False, "num_qvalue_nets": 10}
DATA = {"recovery_target": "data"}
OFFICIAL = {
    "recovery_direction": "reverse",
    "action_reduction": "mean",
    "recovery_states": "perturbed",
    "actor_states": "clean",
}
# The class of each configuration, and what it changes of the class's defaults, which
# are the paper's sizes.
LOSSES = {
    "osr": ("OSRLoss", {}),
    "cql": ("OSRLoss", CQL),
    "cql_bc": ("OSRLoss", DATA | {"recovery_states": "clean", "actor_states": "clean"}),
    "cql_noisy_bc": ("OSRLoss", DATA),
    "osr_official": ("OSRLoss", OFFICIAL),
    "osr_10": ("OSRLoss", OSR_10),
    "sac_10": ("OSRLoss", OSR_10 | CQL),
    "mopo": ("OSRLoss", CQL | {"min_q_weight": 0.0, "deterministic_backup": False}),
    "scas": ("SCASLoss", {"num_qvalue_nets": 4}),
    "rambo": ("OSRLoss", CQL | {"min_q_weight": 0.0, "deterministic_backup": False}),
    "romi": ("OSRLoss", CQL),
    "sdc": ("SDCLoss", {}),
    "edac_10": ("EDACLoss", {"num_qvalue_nets": 10}),
    "osr_v": ("OSRVLoss", {}),
    "osr_v_data": ("OSRVLoss", DATA),
    "td3_bc": ("TD3BCLoss", {}),
    "rim": ("TD3BCLoss", {}),
    # For the default data, Hopper's medium-replay, its authors' settings.
    "rebrac": ("ReBRACLoss", {"actor_bc_coef": 0.05, "critic_bc_coef": 0.5}),
    "rorl": ("RORLLoss", {"num_qvalue_nets": 10}),
    "iql": ("IQLLoss", {}),
    "bc": ("BCLoss", {}),
    "noisy_bc": ("BCLoss", {"states": "both"}),
    "discrete_osr": ("DiscreteOSRLoss", {}),
    "discrete_cql": ("DiscreteOSRLoss", CQL),
}


def test_every_loss_configuration_is_listed():
    assert sorted(LOSSES) == options("loss")


@pytest.mark.parametrize("name", LOSSES)
def test_loss_is_the_class_with_these_options(name):
    target, expected = LOSSES[name]
    loss = train("preset=paper", f"loss={name}").loss
    loss_class = getattr(objectives, target)
    assert get_class(loss._target_) is loss_class
    # What refuses a mistyped key or value.
    assert OmegaConf.get_type(loss).__name__ == schema_of(loss_class).__name__
    assert changed(loss) == expected


@pytest.mark.parametrize(("name", "number"), [("cql", 6), ("osr_10", 6), ("osr_v", 1)])
def test_number_of_sampled_actions_is_one_for_all_losses_with_cqls_term(name, number):
    assert train(f"loss={name}", "num_random=6").loss.num_random == number


@pytest.mark.parametrize("name", options("inverse_dynamics"))
def test_model_config_is_the_model_loss_modules_vocabulary(name):
    cfg = train(f"inverse_dynamics={name}").inverse_dynamics
    model = instantiate(cfg.network, 3, 2, num_cells=[4])
    loss = instantiate(cfg.loss, model)
    assert type(loss) is InverseDynamicsLoss
    assert (loss.states, loss.action_error, loss.latent_weight) == (
        cfg.loss.states,
        cfg.loss.loss_function,
        cfg.loss.latent_weight,
    )


def test_adversarial_perturbation_is_the_noise_and_the_class_default():
    adversarial, gaussian = (
        train(f"perturbation={name}").perturbation
        for name in ("adversarial", "gaussian")
    )
    assert instantiate(adversarial.adversary) == Adversary()
    assert gaussian.adversary is None
    assert adversarial.std == gaussian.std
    options = [f"perturbation.adversary.{x}" for x in ("objective=min_Q", "epsilon=1")]
    tried = train("perturbation=adversarial", *options).perturbation
    assert instantiate(tried.adversary) == Adversary("min_Q", epsilon=1.0)
    with pytest.raises(ConfigCompositionException) as error:
        train("perturbation=adversarial", "perturbation.adversary.epsilonn=1")
    assert "epsilonn" in f"{error.value} {error.value.__cause__}"


def test_official_preset_reaches_every_group_and_quick_sizes_stay_possible():
    cfg = train("preset=official")
    assert cfg.loss == train("loss=osr_official", "preset=paper").loss
    assert cfg.inverse_dynamics == train("inverse_dynamics=cvae").inverse_dynamics
    assert (cfg.data.standardize, cfg.trainer.steps) == (False, 4_000_000)
    quick = train("loss=osr_official", "inverse_dynamics=cvae")
    assert quick.loss.recovery_direction == "reverse"
    assert quick.trainer.steps == train().trainer.steps


def test_antmaze_preset_is_corls_cql():
    cfg, paper = train("preset=antmaze"), train("preset=paper")
    # tinkoff-ai/CORL at 140648a, configs/offline/cql/antmaze/umaze_v2.yaml
    assert (cfg.data.reward_scale, cfg.data.reward_shift) == (10, -5)
    assert (cfg.loss.with_lagrange, cfg.loss.lagrange_thresh) == (True, 0.8)
    assert (cfg.loss.min_q_weight, cfg.loss.clip_diff_min) == (5, -200)
    assert (cfg.loss.max_q_backup, cfg.loss.deterministic_backup) == (True, True)
    assert (cfg.loss.num_random, cfg.loss.temperature) == (10, 1)
    assert (cfg.optim.actor_lr, cfg.optim.qvalue_lr) == (1e-4, 3e-4)
    assert (cfg.optim.gamma, cfg.optim.tau) == (0.99, 5e-3)
    assert (cfg.trainer.eval_episodes, cfg.trainer.steps) == (100, 1_000_000)
    assert (cfg.trainer.eval_interval, cfg.trainer.batch_size) == (50_000, 256)
    assert cfg.optim == paper.optim


def test_schema_documents_every_field():
    schemas = [
        schema
        for schema in vars(config).values()
        if is_dataclass(schema) and schema.__module__ == config.__name__
    ]
    assert config.TrainConfig in schemas
    for schema in schemas:
        own = fields(schema)
        if schema is config.TrainConfig:
            # The groups have classes of their own.
            own = [each for each in own if each.default_factory is MISSING]
        for name in {each.name for each in own} - {"_target_", "loss"}:
            assert f"{name}:" in schema.__doc__, f"{schema.__name__}.{name}"
