"""The training of an agent for a number of steps, which ``train-options`` and ``train-meta`` share.

- step: one primitive action in one environment. Budgets, logs and curves count steps.
- joint step: a step in each of the E environments at once, so E steps. One call of ``OptionLoop.step`` is a joint step.
- update of the option policies: one gradient step on a batch of replayed steps, every ``update_interval`` steps.
- update of the meta-policy: ``epochs`` passes over the last ``decisions`` decisions.

:mod:`hypogoal.options.loop` says what an option's end means for each of the policies that learn.
"""

from hypogoal.core.artefacts import Artefact
from hypogoal.core.checkpoints import Checkpoints, State
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.tensors import load_tensors
from hypogoal.options.loop import OptionLoop

LOG_INTERVAL = 2_000  # environment steps between two lines of the log


def train(
    loop: OptionLoop,
    steps: int,
    log: MetricsLog,
    progress: Progress,
    checkpoints: Checkpoints,
    until: float = 0.0,
) -> bool:
    """Step ``loop`` for ``steps`` more environment steps. If there is a checkpoint, go on from it.

    Training ends earlier once a share ``until`` of the last episodes has succeeded. With ``until`` 0, training never
    ends earlier. Returns whether the share was reached.
    """
    recorder, begin = loop.recorder, loop.recorder.steps
    checkpoints = checkpoints if loop.engine.resumes else Checkpoints(None)
    logged = begin  # the number of steps at the last line of the log
    numbers = {}  # the numbers to log of the last updates
    saved = checkpoints.load()
    if saved:
        loop.restore(saved["loop"])
        logged, numbers = saved["logged"], saved["numbers"]
        progress.resume(recorder.steps - begin)
    log.restore(saved["log"] if saved else 0)

    def state() -> State:
        return {"loop": loop.snapshot(), "logged": logged, "numbers": numbers, "log": log.snapshot()}

    solved = recorder.episodes.solved(until)
    while recorder.steps - begin < steps and not solved:
        numbers |= loop.step()
        done, solved = recorder.steps - begin, recorder.episodes.solved(until)
        shown = {}
        if recorder.steps - logged >= LOG_INTERVAL or done >= steps or solved:
            logged = recorder.steps
            shown = recorder.recent(restarted=loop.config.restart_options)
            reached = {"until_reached": solved} if until else {}
            log.write(
                step=logged,
                episodes=len(recorder.episodes.rows),
                states=loop.engine.n_states,
                **shown,
                **numbers,
                **reached,
            )
        progress.update(min(done, steps), **shown)
        checkpoints.offer(state)
    return solved


def continue_with(loop: OptionLoop, trained: Artefact) -> None:
    """Load the options of the artefact ``trained`` into ``loop``, to go on learning. Replays start empty."""
    weights = load_tensors(trained.path / "options.safetensors")
    loop.learner.load(weights)
    loop.terminations.rule.load(weights)
