"""Settings of option learning, with the light recipe as defaults and the paper's values in its preset."""

from hypogoal.core.config import OWN, Config, part, setting

STACK = 4  # the most steps that an observation looks back, because a state is forgotten with its oldest frame


class LearnerConfig(Config):
    """How option policies learn, with network=light or paper."""

    bounded_values: bool = setting(
        True,
        "clip the targets of an option's values to 0..1, because an option's return is in that range",
        source="ours; paper: false",
    )
    option_gamma: float = setting(0.95, "discount per step inside an option", low=0.0, high=1.0)
    replay: int = setting(100_000, "number of transitions that the replay keeps", source="Table 4", low=100)
    warm_up: int = setting(1_000, "environment steps before the first update", unit="steps", low=1)
    update_interval: int = setting(8, "environment steps between two updates", unit="steps", source="paper: 4", low=1)
    option_batch: int = setting(128, "transitions in each update", source="paper: 32", low=1)
    option_learning_rate: float = setting(5e-4, "Adam's step size", source="paper: 2.5e-4", low=0.0)
    target_interval: int = setting(
        0,
        "updates between two copies of the network into the target network; 0: the target network follows by 1 % at "
        "each update",
        source="0: ours; paper: 10",
        low=0,
    )
    exploration: str = setting(
        "independent",
        "how long a random action lasts: independent, one step; persistent, several steps",
        source="persistent: Dabney et al. 2020",
        choices=("independent", "persistent"),
    )
    epsilon_steps: int = setting(
        2_000,
        "steps in which epsilon, the probability of a random action, falls from 1 to its final value",
        unit="steps",
        source="ours: options behind other options learn in time; Table 4: 8,000",
        low=1,
    )
    epsilon_final: float = setting(
        0.05, "the final probability of a random action", source="paper: 0.01", low=0.0, high=1.0
    )
    epsilon_from: str = setting(
        "first-positive",
        "when the epsilon of a member's option begins to fall: start, at once; first-positive, once its sub-goal was "
        "first reached",
        source="paper: start",
        choices=("start", "first-positive"),
    )


class LightConfig(LearnerConfig):
    """Settings that only network=light has."""

    embedding: str = setting(
        "auto",
        "how the network reads observations: auto, by cells, convolutions or numbers, whichever suits them; or by the "
        "layers of a member network, by name or as module:function",
        source="ours",
    )
    n_step: int = setting(
        1,
        "steps of an n-step return within one execution; more than 1 needs experience=own",
        unit="steps",
        source="paper: 1; Hessel et al. 2018",
        low=1,
        high=1_000,
    )


class PaperConfig(LearnerConfig):
    """Settings that only network=paper has."""

    recurrence: int = setting(
        1,
        "number of the last states of an execution, the present state included, that the conv-GRU sees; the value of "
        "option_timeout means all states",
        unit="steps",
        source="1: the authors' code",
        low=1,
        high=1_000,
    )


class OwnLearnerConfig(LightConfig, PaperConfig):
    """All settings that an option learner of your own may use."""


class OptionConfig(Config):
    """How the intra-option policies are executed and learned."""

    network: str = setting(
        "light",
        "how options act: light, by a small Q-network; paper, by the paper's larger one, a conv-GRU; planned, by the "
        "shortest path, if the domain knows what each action leads to",
        source="paper, appendix; the others: ours",
        choices=("light", "paper", "planned"),
        own=True,
    )
    termination: str = setting(
        "learned",
        "where options end: learned, where their member first says yes; oracle, where the sub-goal truly holds, which "
        "shows what right members could do; or by a rule of your own",
        source="paper: learned",
        choices=("learned", "oracle"),
        own=True,
    )
    experience: str = setting(
        "shared",
        "which options learn from a step: own, the option that ran; shared, the options of all members",
        source="own: paper",
        choices=("own", "shared"),
    )
    option_timeout: int = setting(
        10, "an option ends after this many steps at the latest", unit="steps", source="paper", low=1, high=32_000
    )
    restart_options: bool = setting(
        False, "every option begins a new episode, at a start state", source="paper, policy learning"
    )
    mask_reached: bool = setting(True, "do not offer options where their sub-goal already holds", source="ours")
    environments: int = setting(16, "number of environments that are stepped together", low=1, high=4096)
    learner: LearnerConfig | None = part("network", {"light": LightConfig, "paper": PaperConfig, OWN: OwnLearnerConfig})
