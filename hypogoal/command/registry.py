"""Every stage and tool by the name of its command, and how it is loaded."""

from importlib import import_module
from typing import TYPE_CHECKING

from hypogoal.core.errors import UserError

if TYPE_CHECKING:
    from hypogoal.command.stage import Stage

LISTED = {  # every stage and tool in a line, after those whose outputs it reads; it is loaded when it is called
    "collect": "Collect labelled, unlabelled and held-out states.",
    "import": "Make a data file of your arrays, pictures or recorded episodes.",
    "train-ensemble": "Train diverse classifiers (members) of each sub-goal.",
    "train-options": "Learn an option (a policy) for every member.",
    "train-meta": "Learn from the reward which options to choose.",
    "train-baseline": "Train PPO or DQN on primitive actions, to compare.",
    "evaluate": "Compute every number of a run: accuracy, curves, choices.",
    "report": "Draw the report of an evaluated run: one HTML file.",
    "compare": "Put evaluated runs side by side: what differs, who wins.",
    "export": "Write an agent's episodes or an ensemble for other software.",
    "audit": "How often, and where, do policies fool a success classifier?",
}
LOOK, OWN = "Look", "Own data and code"  # groups of commands
TOOLS = {"compare": LOOK, "import": OWN, "export": OWN, "audit": OWN}


def load_stage(name: str) -> "Stage":
    """The stage of a command; an unknown one is a ``UserError``."""
    if name not in LISTED:
        raise UserError("this is no stage", name, f"Choose one of {', '.join(LISTED)}.")
    folder = "tools" if name in TOOLS else "stages"
    word = "import_data" if name == "import" else name.replace("-", "_")
    function = getattr(import_module(f"hypogoal.{folder}.{word}"), word)
    return function.stage
