"""What audits are of: the members of an ensemble, or code of the user's own (Spec H5, I6)."""

from pathlib import Path
from typing import Any

import numpy as np

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


class OwnClassifier:
    """Code of the user's own, ``module:function``, as an ensemble of one member; anything else is a ``UserError``."""

    thresholds = np.array([THRESHOLD])

    def __init__(self, name: str):
        self.name = name
        self.function = load(name, "classifier", "hypogoal.classifiers", {})
        if not callable(self.function):
            do = "Give one from observations (N, *obs) to probabilities (N,)."
            raise UserError("this is not a function", name, do)

    def predict(self, observations: Observations) -> Any:
        """Probabilities (n, 1) of observations (n, *obs)."""
        parts = []
        for some in np.split(observations, range(CHUNK, len(observations), CHUNK)):
            probabilities = np.asarray(self.function(some), dtype=np.float64)
            if probabilities.shape != (len(some),) or not ((probabilities >= 0) & (probabilities <= 1)).all():
                fault = f"the classifier gave {probabilities.shape} {probabilities.ravel()[:3]}"
                raise UserError(fault, self.name, f"Give probabilities, 0 to 1, float ({len(some)},).")
            parts.append(probabilities)
        return np.concatenate(parts)[:, None]

    def log_odds(self, observations: Observations) -> Any:
        """Log-odds (n, 1) of observations (n, *obs)."""
        return log_odds_of(self.predict(observations))


Classifier = Ensemble | OwnClassifier


def classifier_of(
    name: str,
    sub_goal: str,
    device: str,
) -> tuple[Classifier, Artefact | None]:
    """The members of an ensemble artefact, and that, or code of the user's own; anything else is a ``UserError``."""
    if ":" in name and not Path(name).is_dir():
        return OwnClassifier(name), None
    source = open_artefact(Path(name), "ensemble")
    ensemble = read_ensemble(source.path, source.config, sub_goal)
    return ensemble.to(device), source
