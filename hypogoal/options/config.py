"""Settings of option learning, with the light recipe as defaults and the paper's values in its preset."""

from hypogoal.core.config import OWN, Config, part, setting

STACK = 4  # steps that an observation looks back at most: a state is forgotten with its oldest frame


class LearnerConfig(Config):
    """How option policies learn, with network=light or paper."""

    bounded_values: bool = setting(
        True, "clip the targets of values to 0..1, the range of an option's return", source="ours; paper: false"
    )
    option_gamma: float = setting(0.95, "discount per step inside an option", low=0.0, high=1.0)
    replay: int = setting(100_000, "transitions kept", source="Table 4", low=100)
    warm_up: int = setting(1_000, "steps before the first update", unit="steps", low=1)
    update_interval: int = setting(8, "environment steps per update", unit="steps", source="paper: 4", low=1)
    option_batch: int = setting(128, "transitions per update", source="paper: 32", low=1)
    option_learning_rate: float = setting(5e-4, "Adam's step size", source="paper: 2.5e-4", low=0.0)
    target_interval: int = setting(
        0,
        "updates between two copies of the network into the target network; 0: it follows by 1 % at each update",
        source="0: ours; paper: 10",
        low=0,
    )
    exploration: str = setting(
        "independent",
        "how long a random action lasts: one step, or several",
        source="persistent: Dabney et al. 2020",
        choices=("independent", "persistent"),
    )
    epsilon_steps: int = setting(
        2_000,
        "steps until the final epsilon",
        unit="steps",
        source="ours: options behind other options learn in time; Table 4: 8,000",
        low=1,
    )
    epsilon_final: float = setting(0.05, "final epsilon", source="paper: 0.01", low=0.0, high=1.0)
    epsilon_from: str = setting(
        "first-positive",
        "when a member's epsilon begins to fall",
        source="paper: start",
        choices=("start", "first-positive"),
    )


class LightConfig(LearnerConfig):
    """What only network=light has."""

    embedding: str = setting(
        "auto",
        "how the network reads observations: cells, convolutions or numbers, whichever suits them; or a member "
        "network's layers, by name or as module:function",
        source="ours",
    )
    n_step: int = setting(
        1,
        "steps of an n-step return, within one execution (experience=own)",
        unit="steps",
        source="paper: 1; Hessel et al. 2018",
        low=1,
        high=1_000,
    )


class PaperConfig(LearnerConfig):
    """What only network=paper has."""

    recurrence: int = setting(
        1,
        "states of its execution that the conv-GRU sees, the last of them the present one; the option's timeout: all",
        unit="steps",
        source="1: the authors' code",
        low=1,
        high=1_000,
    )


class OwnLearnerConfig(LightConfig, PaperConfig):
    """All that an option learner of one's own may heed."""


class OptionConfig(Config):
    """How the intra-option policies are executed and learned."""

    network: str = setting(
        "light",
        "Q-network: light, a small one on cells; paper, a conv-GRU; or, where an engine knows what each action leads "
        "to: planned, the shortest path",
        source="paper, appendix; the others: ours",
        choices=("light", "paper", "planned"),
        own=True,
    )
    termination: str = setting(
        "learned",
        "where options end: learned, at the first positive prediction; oracle, at true sub-goals (upper bound); or a "
        "rule of your own",
        source="paper: learned",
        choices=("learned", "oracle"),
        own=True,
    )
    experience: str = setting(
        "shared",
        "which members learn from a step: its own, or all of them (shared)",
        source="own: paper",
        choices=("own", "shared"),
    )
    option_timeout: int = setting(
        10, "an option ends after this many steps", unit="steps", source="paper", low=1, high=32_000
    )
    restart_options: bool = setting(
        False, "every option begins a new episode, at a start state", source="paper, policy learning"
    )
    mask_reached: bool = setting(True, "do not offer options where their sub-goal already holds", source="ours")
    environments: int = setting(16, "environments stepped together", low=1, high=4096)
    learner: LearnerConfig | None = part("network", {"light": LightConfig, "paper": PaperConfig, OWN: OwnLearnerConfig})
