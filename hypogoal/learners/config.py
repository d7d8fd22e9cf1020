"""Settings of the world in which an agent plays, with options or with the primitive actions."""

from hypogoal.core.config import Config, setting


class WorldConfig(Config):
    """The world that an agent plays in."""

    layout_seed: int = setting(100, "the layout the agent lives on", source="paper, Figure 6", low=0)
    start: str = setting(
        "",
        "where episodes begin, in a domain that names several places",
        source="paper, policy learning",
    )
    max_episode_steps: int = setting(
        500, "an episode is cut after this many steps", unit="steps", source="paper, MiniGrid experiment", low=1
    )
    cap: float = setting(
        0.0,
        "an episode is cut after this many times the layout's shortest path; 0 for max_episode_steps",
        source="ours: a task in which choosing decides",
        low=0.0,
    )
    world: tuple[str, ...] = setting(
        (),
        "changes to the world that the states were collected in: settings of the domain as name=value",
        source="ours: a task in which choosing decides",
    )
