"""The fast DoorKey engine for training. Read ``env`` first, which has the rules. Tests compare the two step by step.

Drawing is 99 % of MiniGrid's cost. In this engine a step is a few table look-ups for all environments together. An
image is eight strips, which are rows of cells. Few strips differ, so each strip is drawn once.

A state is a *configuration* (the layout, its door and where its three keys are) and a *pose* (the agent's cell and
direction). Turning and walking change the pose only, by table look-ups in NumPy. Picking up, dropping and toggling
change the configuration. Such changes are rare, so plain Python computes them. Every state reached gets an id.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.random import Generator

from hypogoal.core.arrays import Bools, Bytes, Ints
from hypogoal.domains.base import Engine, Layouts, Plan, Step
from hypogoal.domains.doorkey import rules
from hypogoal.domains.doorkey.env import MAX_STEPS, OBSERVATION_SHAPE, SIZE, judge_sub_goals, make_layout
from hypogoal.domains.doorkey.search import search
from hypogoal.domains.doorkey.strips import UNKNOWN, Strips, lengthen

START = 0  # the id of the start state; with several layouts, of the start state of the first layout played
# The engine's tables that grow. They have a row for each state, or for each configuration.
PER_STATE = ("_site", "_ahead", "_codes", "_on_goal", "_final")
PER_CONFIGURATION = ("_configurations", "_bare_codes", "_id_at")

Configuration = tuple[int, ...]  # the layout's seed, the door, and the places of the blue, the green and the red key


class DoorKeyEngine(Engine):
    """Many environments of one layout or several, stepped together. Ids never change, and the start state has START.

    The arguments are those of ``DoorKeyEnv``, except ``count``, the number of environments, and ``layouts``, a layout's
    seed or the layouts to begin episodes in.
    """

    n_actions = rules.N_ACTIONS
    observation_shape = OBSERVATION_SHAPE
    restarts = resumes = True
    n_states = 0

    def __init__(
        self,
        layouts: int | Layouts,
        count: int = 1,
        *,
        max_steps: int = MAX_STEPS,
        door_label: str = "open",
        wrong_key: str = "harmless",
    ):
        self.count, self.max_steps = count, max_steps
        self.door_label = door_label
        self.harsh = wrong_key == "ends"
        self.layouts: Layouts = layouts if isinstance(layouts, Layouts) else Layouts((layouts,))
        self._numbers: dict[Configuration, int] = {}
        # Rows by configuration: the configuration itself, its cell codes without the agent, and ids by pose.
        self._configurations = np.zeros((16, 5), int)
        self._bare_codes = np.zeros((16, rules.CELLS), np.uint8)
        self._id_at = np.full((16, rules.POSES), UNKNOWN, int)
        # Rows by id: configuration * rules.POSES + pose, the index of the cell ahead in the bare codes, the cell codes,
        # whether the agent is on the goal, and whether the episode ends.
        self._site = np.zeros(256, int)
        self._ahead = np.zeros(256, int)
        self._codes = np.zeros((256, rules.CELLS), np.uint8)
        self._on_goal = np.zeros(256, bool)
        self._final = np.zeros(256, bool)
        self._strips = Strips(self.codes, len(self._site))
        self.reset()

    @property
    def tiles(self) -> Bytes:
        return rules.tiles()

    def _begin(self, number: int) -> int:
        seed = self.layouts.begin(number)
        return self._find_start(seed)

    def _find_start(self, seed: int) -> int:
        """Return the start state of a layout."""
        layout = make_layout(seed)
        configuration = self._enter_configuration((seed, rules.LOCKED, *layout.keys))
        pose = layout.start * 4 + layout.direction
        return self._enter_state(configuration * rules.POSES + pose)

    def _find_starts(self, seeds: Sequence[int]) -> Ints:
        return np.array([self._find_start(seed) for seed in seeds])

    def step(self, actions: Ints) -> Step:
        following = self.follow(self.ids, actions)
        terminated = self._final.take(following)
        self.ids = following
        self.elapsed = self.elapsed + 1
        truncated = self.elapsed >= self.max_steps
        self.restart(terminated | truncated)
        rewards = self.at_goal(following).astype(np.float32)
        return Step(following, rewards, terminated, truncated)

    def follow(self, ids: Ints, actions: Ints) -> Ints:
        """Return the next states, int64 (n,), by MiniGrid's rules, after actions, int (n,) of 0 .. 6."""
        site = self._site.take(ids)
        pose = site & (rules.POSES - 1)
        ahead = self._ahead.take(ids)
        code_ahead = self._bare_codes.ravel().take(ahead)
        case = np.asarray(actions, int) * rules.N_CODES + code_ahead
        following_site = site + rules.MOVES.take(case * rules.POSES + pose)
        [changing] = rules.MAY_CHANGE.take(case).nonzero()
        for index in changing.tolist():
            action = int(actions[index])
            changed = self._change(site.item(index), action)
            following_site[index] = changed * rules.POSES + pose.item(index)
        following = self._id_at.ravel().take(following_site)
        [new] = (following < 0).nonzero()
        for index in new.tolist():
            following[index] = self._enter_state(following_site.item(index))
        return following

    def _change(self, site: int, action: int) -> int:
        """Return the configuration after an action that ``MAY_CHANGE`` it, so a pickup, a drop or a toggle."""
        configuration, pose = divmod(site, rules.POSES)
        seed, door, *keys = self._configurations[configuration].tolist()
        last = max(keys)
        if action == rules.DROP and last < rules.HELD:  # no key is held, as at most drops of a random policy
            return configuration
        front = rules.AHEAD.item(pose)
        has_red_key = keys[-1] >= rules.HELD
        if action == rules.PICKUP:
            keys[keys.index(front)] = max(rules.HELD, last + 1)
        elif action == rules.DROP:
            keys[keys.index(last)] = front
        elif action == rules.TOGGLE:
            if door == rules.OPEN:
                door = rules.CLOSED
            elif door == rules.CLOSED or has_red_key:  # once unlocked it never locks again
                door = rules.OPEN
        return self._enter_configuration((seed, door, *keys))

    def images(self, ids: Ints) -> Bytes:
        return self._strips.images(ids)

    def codes(self, ids: Ints) -> Bytes:
        """Return each state's cell codes, uint8 (n, 64), row by row. With ``tiles()`` they give the whole image."""
        return self._codes.take(ids, axis=0)

    def at_goal(self, ids: Ints) -> Bools:
        """Return whether the agent is on the goal, bool (n,)."""
        return self._on_goal.take(ids)

    def labels(self, ids: Ints) -> Bools:
        """Return whether each sub-goal truly holds, bool (n, G), in the order of ``SUB_GOALS``."""
        configurations = self._configurations[self._site.take(ids) // rules.POSES]
        door_open = configurations[:, 1] == rules.OPEN
        held = configurations[:, 2:] >= rules.HELD
        ahead = self._ahead.take(ids)
        facing_door = self._bare_codes.ravel().take(ahead) >= rules.DOOR
        return judge_sub_goals(
            held,
            door_open,
            facing_door,
            on_goal=self.at_goal(ids),
            door_label=self.door_label,
        )

    def origins(self, ids: Ints) -> dict[str, Ints]:
        """Return the states' origins agent_x, agent_y, direction, door_state and keys_held, int64 (n,) each.

        ``door_state`` is MiniGrid's (0 open, 1 closed, 2 locked). ``keys_held`` has bit 0 for the blue key, bit 1 for
        the green key, and bit 2 for the red key.
        """
        number, pose = np.divmod(self._site.take(ids), rules.POSES)
        cell, direction = np.divmod(pose, 4)
        configurations = self._configurations[number]
        return {
            "agent_x": cell % SIZE,
            "agent_y": cell // SIZE,
            "direction": direction,
            "door_state": configurations[:, 1],
            "keys_held": (configurations[:, 2:] >= rules.HELD) @ rules.KEY_BITS,
        }

    def is_final(self, ids: Ints) -> Bools:
        """Return whether the episode ends in states, bool (n,)."""
        return self._final.take(ids)

    def search(self, starts: Ints | None = None) -> tuple[Ints, Ints, Ints]:
        """Search from ``starts``, ids (n,), by default those of all layouts, as :func:`.search.search` says."""
        if starts is None:
            starts = self._find_starts(self.layouts.seeds)
        return search(self, starts)

    def reachable(self) -> Ints:
        """Return the ids of all states reachable from the start, nearest first, one for each image.

        States that differ only in the order of the keys on the ring look the same. The first state stands for all.
        """
        ids, *_ = self.search()
        codes = self.codes(ids)
        looks = codes.view(f"V{rules.CELLS}")[:, 0]
        _, first = np.unique(looks, return_index=True)
        return ids[np.sort(first)]

    def plan(self, starts: Ints | None = None) -> Plan:
        """Return the transitions between all states, except some ten million to which only dropping a key leads."""
        ids, _, following = self.search(starts)
        return Plan(
            ids,
            rules.SEARCHED,
            following,
            final=self.is_final(ids),
            solved=self.at_goal(ids),
        )

    def shortest_path(self) -> int | None:
        """Return the fewest primitive steps to the goal.

        The result is None with several layouts, or if the way is free only once a wrong key, which ends the episode, is
        picked up.
        """
        if self.layouts.many:
            return None
        ids, steps, _ = self.search()
        to_goal = steps[self.at_goal(ids)]
        return int(to_goal.min()) if len(to_goal) else None

    def random_success(self, episodes: int, rng: Generator) -> float:
        """Return the share of ``episodes`` of uniformly random actions that reach the goal within ``max_steps``."""
        seeds = rng.choice(self.layouts.seeds, episodes)
        ids = self._find_starts(seeds.tolist())
        solved = 0
        for _ in range(self.max_steps):
            actions = rng.integers(rules.N_ACTIONS, size=len(ids))
            ids = self.follow(ids, actions)
            solved += int(self.at_goal(ids).sum())
            ids = ids[~self._final[ids]]
        return solved / episodes

    def snapshot(self) -> dict[str, Any]:
        """Return all that a resumed run needs: each environment's state, and the ids assigned so far."""
        return {
            **super().snapshot(),
            "configurations": self._configurations[: len(self._numbers)].copy(),
            "sites": self._site[: self.n_states].copy(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments. Call this before the first step."""
        for configuration in snapshot["configurations"].tolist():
            self._enter_configuration(tuple(configuration))
        for site in snapshot["sites"].tolist():
            self._enter_state(site)
        super().restore(snapshot)

    def _enter_state(self, site: int) -> int:
        """Return the id of a state. If the state has none, it gets a new id."""
        state = self._id_at.item(site)
        if state != UNKNOWN:
            return state
        new = self.n_states
        if new == len(self._site):
            self._double(PER_STATE)
            self._strips.make_room()
        configuration, pose = divmod(site, rules.POSES)
        cell, direction = divmod(pose, 4)
        codes = self._codes[new]
        codes[:] = self._bare_codes[configuration]
        under = codes.item(cell)
        codes[cell] = rules.AGENT_ON.item(under) + direction
        self._site[new] = site
        self._ahead[new] = configuration * rules.CELLS + rules.AHEAD.item(pose)
        _, _, blue, green, _ = self._configurations[configuration].tolist()
        at_goal = under == rules.GOAL
        self._on_goal[new] = at_goal
        is_wrong = self.harsh and max(blue, green) >= rules.HELD
        self._final[new] = at_goal or is_wrong
        self._id_at[configuration, pose] = new
        self.n_states += 1
        return new

    def _enter_configuration(self, configuration: Configuration) -> int:
        """Return the number of a configuration. If the configuration has none, it gets a new number."""
        number = self._numbers.get(configuration)
        if number is not None:
            return number
        new = self._numbers[configuration] = len(self._numbers)
        if new == len(self._configurations):
            self._double(PER_CONFIGURATION)
        seed, door, *keys = configuration
        layout = make_layout(seed)
        row = bytearray(rules.CELLS)  # because an array is slower
        for cell in layout.walls:
            row[cell] = rules.WALL
        row[layout.goal] = rules.GOAL
        row[layout.door] = rules.DOOR + door
        for colour, place in enumerate(keys):
            if place < rules.HELD:
                row[place] = rules.KEY + colour
        self._configurations[new] = configuration
        self._bare_codes[new] = np.frombuffer(row, np.uint8)
        return new

    def _double(self, names: Sequence[str]) -> None:
        """Double the number of rows of the tables ``names``."""
        for name in names:
            setattr(self, name, lengthen(getattr(self, name)))
