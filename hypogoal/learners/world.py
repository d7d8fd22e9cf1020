"""Where agents play, whatever learns: the settings that options, agents over them and baselines have in common."""

from dataclasses import dataclass

from hypogoal.core.config import setting


@dataclass(frozen=True)
class WorldConfig:
    """The layout, what is otherwise in its world, and when an episode is cut."""

    layout_seed: int = setting(100, "the layout the agent lives on", source="paper, Figure 6", low=0)
    max_episode_steps: int = setting(
        500, "an episode is cut after this many steps", unit="steps", source="paper, MiniGrid experiment", low=1
    )
    cap: float = setting(
        0.0,
        "an episode is cut after so many times the layout's shortest path; 0 for max_episode_steps",
        source="ours: a task in which choosing decides",
        low=0.0,
    )
    world: tuple[str, ...] = setting(
        (),
        "what is otherwise in the world than where the states were collected, or by default: settings of the domain as "
        "name=value",
        source="ours: a task in which choosing decides",
    )
    random_episodes: int = setting(200, "episodes of random play that say how hard the layout is", source="ours", low=0)
