"""What policies see that do not see all of a picture: the neighbourhood of the agent (ours)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import UserError
from hypogoal.dataset import PICTURE
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.localisers import Localiser
from hypogoal.hypotheses.views import AgentView, cut_windows
from hypogoal.options.config import FULL, OptionConfig
from hypogoal.options.parts import Part, load_part

SIDE = 42  # pixels, half of what is seen of Montezuma's Revenge
VIEWS = {"agent-crop": f"{__name__}:AgentCrop"}

Pictures = NDArray[np.uint8]  # (N, H, W, C)


class PolicyView(Part, ABC):
    """Turns pictures (N, H, W, C) into those that policies see, (N, *shape)."""

    shape: tuple[int, ...]

    @classmethod
    def refuse(cls, config: OptionConfig, engine: Engine) -> None:
        """Raise a ``UserError`` where policies cannot see so; by default, where observations are no pictures."""
        if engine.observation_dtype != PICTURE:
            raise UserError(
                "policies have views of pictures only", f"policy_view={config.policy_view}", "Leave it out."
            )

    @classmethod
    def create(cls, shape: tuple[int, ...], ensemble: Callable[[], Ensemble]) -> Self:
        """A view of pictures of this shape, (H, W, C); ``ensemble`` reads the first of the options' ensembles."""
        return cls(shape)  # type: ignore[call-arg]

    @abstractmethod
    def see(self, pictures: Pictures, ids: NDArray[np.int64] | None = None) -> Pictures:
        """What policies see of pictures, uint8 (N, *shape); of an engine's states ``ids`` are known, (N,)."""


class AgentCrop(PolicyView):
    """The window of ``SIDE`` pixels around the agent, who is looked for once in each of an engine's states."""

    CHANGING = ("_centres",)

    def __init__(self, shape: tuple[int, ...], localiser: Localiser):
        self.shape, self.localiser = (SIDE, SIDE, *shape[2:]), localiser
        self._centres = np.full((1024, 2), np.nan)  # of states by id

    @classmethod
    def create(cls, shape: tuple[int, ...], ensemble: Callable[[], Ensemble]) -> Self:
        """With the ensemble's localiser; a ``UserError`` where it has none, or one that policies must not use."""
        source = ensemble()
        if not isinstance(source.view, AgentView) or source.needs_positions:
            fault = "the agent's place in an observation is not known"
            raise UserError(
                fault, "policy_view=agent-crop", "Train the ensemble with view=agent-crop, localiser=learned."
            )
        return cls(shape, source.view.localiser)

    def see(self, pictures: Pictures, ids: NDArray[np.int64] | None = None) -> Pictures:
        centres = self.localiser.locate(pictures) if ids is None else self._centres_of(pictures, ids)
        return cut_windows(pictures, centres, SIDE, SIDE)

    def _centres_of(self, pictures: Pictures, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        if (missing := int(ids.max(initial=-1)) + 1 - len(self._centres)) > 0:
            rows = np.full((max(missing, len(self._centres)), 2), np.nan)
            self._centres = np.concatenate([self._centres, rows])
        distinct, first = np.unique(ids, return_index=True)
        unknown = np.isnan(self._centres[distinct, 0])
        if unknown.any():
            self._centres[distinct[unknown]] = self.localiser.locate(pictures[first[unknown]])
        return self._centres[ids]


class Viewed(Resumable):
    """Pictures of an engine's states as policies see them, through one view after another."""

    CHANGING = ("views",)
    tiles = None

    def __init__(self, engine: Engine, views: Sequence[PolicyView]):
        self.engine, self.views = engine, list(views)
        self.observation_shape = self.views[-1].shape
        self._whole = np.empty((0, *engine.observation_shape), np.uint8)  # used again: quicker than new memory

    def images(self, ids: NDArray[np.int64], out: Pictures | None = None) -> Pictures:
        """uint8 (n, *observation_shape) of states (n,), in ``out`` if given."""
        if len(ids) > len(self._whole):
            self._whole = np.empty((len(ids), *self._whole.shape[1:]), np.uint8)
        pictures: Pictures = self.engine.images(ids, self._whole[: len(ids)])
        for view in self.views:
            pictures = view.see(pictures, ids)
        if out is None:
            return pictures
        out[:] = pictures
        return out

    def codes(self, ids: NDArray[np.int64]) -> NDArray[np.integer]:
        """There are no tiles."""
        raise NotImplementedError


def views_in(policy_view: str) -> list[type[PolicyView]]:
    """The views that this setting names, in the order in which they are applied."""
    return [] if policy_view == FULL else [load_part(policy_view, "policy view", PolicyView, VIEWS)]  # type: ignore[type-abstract]


def create_views(
    kinds: Sequence[type[PolicyView]], shape: tuple[int, ...], ensemble: Callable[[], Ensemble]
) -> list[PolicyView]:
    """Views one behind the other, the first of pictures of this shape."""
    views: list[PolicyView] = []
    for kind in kinds:
        views.append(kind.create(views[-1].shape if views else shape, ensemble))
    return views
