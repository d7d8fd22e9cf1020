"""What is audited: the members of an ensemble, or code of the user's own."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from hypogoal.core.arrays import Doubles
from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load
from hypogoal.hypotheses.ensemble import (
    THRESHOLD,
    Ensemble,
    read_ensemble,
)
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.observations import Observations

CHUNK = 256  # observations that own code is given at once
ASKED_AGAIN = 2_000  # observations of which some are asked again, to see that each has one probability
CLOSE = 0.01  # probabilities this close are equal up to rounding, also in half precision


class OwnClassifier:
    """The user's own code, ``module:function``, which is used as an ensemble of one member.

    Raises ``UserError`` if the name is not that of a function.
    """

    thresholds = np.array([THRESHOLD])

    def __init__(self, name: str):
        self.name = name
        self.asked = 0
        self.function = load(name, "classifier", "hypogoal.classifiers", {})
        if not callable(self.function):
            do = "Give one from observations (N, *obs) to probabilities (N,)."
            raise UserError("this is not a function", name, do)

    def predict(self, observations: Observations) -> Any:
        """Return the probabilities, float64 (n, 1), of observations (n, *obs).

        Raises ``UserError`` if an answer is no array of probabilities, or if a state gets two different ones.
        """
        parts = []
        for some in np.split(observations, range(CHUNK, len(observations), CHUNK)):
            probabilities = self._ask(some)
            parts.append(probabilities)
            if self.asked < ASKED_AGAIN:
                highest = np.argsort(-probabilities)[: 2 + len(some) // 4]
                apart = np.abs(self._ask(some[highest]) - probabilities[highest]).max(initial=0)
                if apart > CLOSE:
                    fault = f"the classifier gives one state probabilities that differ by {apart:.2g}"
                    do = "Have it look at each state alone and draw nothing: call eval() of a torch module."
                    raise UserError(fault, self.name, do)
        return np.concatenate(parts)[:, None]

    def _ask(self, some: Observations) -> Doubles:
        """Return the probabilities of observations. The function gets copies, because it may change them."""
        self.asked += len(some)
        answer = self.function(some.copy())
        if isinstance(answer, torch.Tensor):
            answer = answer.detach().cpu().double()
        try:
            probabilities = np.asarray(answer, float)
        except (TypeError, ValueError, RuntimeError):
            probabilities = np.array(np.nan)  # the answer was words, for example
        if probabilities.shape != (len(some),) or not ((probabilities >= 0) & (probabilities <= 1)).all():
            fault = f"the classifier gave {type(answer).__name__} {probabilities.shape} {probabilities.ravel()[:3]}"
            raise UserError(fault, self.name, f"Give probabilities, 0 to 1, float ({len(some)},).")
        return probabilities

    def log_odds(self, observations: Observations) -> Any:
        """Return the log-odds, float64 (n, 1), of observations (n, *obs)."""
        return log_odds_of(self.predict(observations))


Classifier = Ensemble | OwnClassifier


def classifier_of(
    name: str,
    sub_goal: str,
    device: str,
) -> tuple[Classifier, Artefact | None]:
    """Return the members of an ensemble artefact and the artefact, or the user's own code and None.

    Raises ``UserError`` if ``name`` is neither.
    """
    if ":" in name and not Path(name).is_dir():
        return OwnClassifier(name), None
    source = open_artefact(Path(name), "ensemble")
    ensemble = read_ensemble(source.path, source.config, sub_goal)
    return ensemble.to(device), source
