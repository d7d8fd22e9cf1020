"""Every number of the four baselines, which are PPO and DQN, each in the paper's setting and in a tuned one.

The paper gives Tables 4 and 5 for its own agents only, and says no more of its PPO and DQN baselines. We read the two
tables as the baselines', too. Where the paper gives no value, the value is stable-baselines3's default or ours, and a
comment says which.
"""

from dataclasses import dataclass

from hypogoal.core.config import setting
from hypogoal.domains.world import WorldConfig


@dataclass(frozen=True)
class PPOSettings:
    """Hyperparameters of proximal policy optimisation (Schulman et al. 2017). The defaults are the paper's setting."""

    network: str = "three-conv"  # feature network, see engine_env.py
    environments: int = 4  # number of environments stepped together
    rollout: int = 100  # decisions per update, all environments together (Table 5)
    batch: int = 64  # decisions per minibatch (Table 5)
    epochs: int = 10  # passes over a rollout (Table 5)
    learning_rate: float = 2.5e-4  # Adam's step size (from Table 4, since Table 5 gives none)
    entropy: float = 0.01  # entropy coefficient (Table 5)
    gae_lambda: float = 0.97  # lambda of the advantage estimate (Table 5)
    gamma: float = 0.99  # discount per step (stable-baselines3)
    clip: float = 0.2  # clip range of the probability ratio (stable-baselines3)


@dataclass(frozen=True)
class DQNSettings:
    """Hyperparameters of deep Q-learning (Mnih et al. 2015). The defaults are the paper's setting.

    Four environments with one update per joint step are the paper's "update interval 4" at a quarter of the overhead.
    """

    network: str = "three-conv"  # feature network, see engine_env.py
    environments: int = 4  # number of environments stepped together, with one update per joint step
    replay: int = 100_000  # transitions kept (Table 4)
    batch: int = 32  # transitions per update (Table 4)
    learning_rate: float = 2.5e-4  # Adam's step size (Table 4)
    target_interval: int = 10  # updates between two target updates (Table 4)
    target_tau: float = 1.0  # soft-update rate of the target network (stable-baselines3)
    epsilon_from: str = "start"  # when epsilon begins to fall: start, or first-goal
    epsilon_steps: int = 8_000  # steps until the final epsilon (Table 4)
    epsilon_final: float = 0.01  # final epsilon (Table 4)
    warm_up: int = 1_000  # steps before the first update (ours)
    gamma: float = 0.95  # discount per step (ours, because DQN does not learn a corridor with 0.99)


# Hyperparameters by agent and setting. The tuned settings are the best of a random search on three-key DoorKey, which
# tried thirty settings of each agent on layouts 400 to 402 (docs/results/history.md). PPO's best was the setting that
# had been tuned by hand before. DQN's best, trial 8, explores until it has seen the goal once, and then for long.
HYPERPARAMETERS: dict[tuple[str, str], PPOSettings | DQNSettings] = {
    ("ppo", "paper"): PPOSettings(),
    ("dqn", "paper"): DQNSettings(),
    ("ppo", "tuned"): PPOSettings(
        network="cells",
        environments=32,
        rollout=512,
        batch=128,
        epochs=6,
        learning_rate=5e-4,
        gae_lambda=0.95,
    ),
    ("dqn", "tuned"): DQNSettings(
        network="cells",
        environments=16,
        batch=128,
        learning_rate=8.9e-4,
        target_interval=1,
        target_tau=0.01,
        epsilon_from="first-goal",
        epsilon_steps=32_000,
        epsilon_final=0.05,
    ),
}


class BaselineConfig(WorldConfig):
    """Which agent is trained, and for how long. The field 'setting' chooses the hyperparameters."""

    agent: str = setting(
        "ppo",
        "the algorithm",
        source="paper, Figure 6",
        choices=("ppo", "dqn"),
    )
    steps: int = setting(
        300_000, "number of environment steps, summed over all environments", unit="steps", source="paper: 1.5e6", low=1
    )
    environments: int = setting(
        0,
        "environments stepped together; 0 for the setting's own",
        low=0,
        high=4096,
    )
    # This field is the last, because after it ``setting`` no longer means the function.
    setting: str = setting(
        "tuned",
        "hyperparameters: the paper's tables, or tuned ones",
        source="paper, Figure 6",
        choices=("paper", "tuned"),
    )
