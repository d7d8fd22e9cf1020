"""Texts of strangers on a page (Spec G2): each is escaped; were one not, the page's policy would let nothing run."""

import json
import re
import shutil
from functools import partial
from html.parser import HTMLParser

import h5py
import numpy as np
import pytest
from browser import loaded, needs_browser, title_of
from command_line import refuses
from ladder_run import (
    DOMAIN,
    SHAPE,
    SUB_GOAL,
    LadderDomain,
    executions,
    heldout,
    seen_with,
    write_members,
    write_options,
)
from toy_data import fill, reseal

from hypogoal.core.artefacts import MANIFEST, create, sha256_of
from hypogoal.core.files import write_table
from hypogoal.data import Collected, States, create_hdf5, fixed, write_dataset
from hypogoal.evaluation.figure_files import draw_figures
from hypogoal.evaluation.page import Material
from hypogoal.evaluation.questions import render
from hypogoal.evaluation.run import fitting, read_evaluation
from hypogoal.options.tables import Choices, Episodes
from hypogoal.stages.evaluate import evaluate
from hypogoal.stages.report import report
from hypogoal.tools.compare import compare

FOLDERS = ('"><img src=x onerror=alert(1)>', "'-alert(1)-'", "a&b<b>")  # file systems take such names
OPEN = re.compile(r"(config|versions|counts\.\w+|quantities|files)$")  # dictionaries with keys of any name
# What is gone by, so that another text there may well be refused: in a page, in an evaluation, in a comparison.
GOES_BY = (
    r"sub_goal$|scope$|states\.\*\.kind|columns\.\*\.path|^metrics\.ensembles\.\*\.path|(saliency|explorer)\.ensemble"
    r"|counts\.|arrays\.examples.*kinds"
)
MADE_BY = (
    r"kind$|inputs\..*sha256$|relative$|files|observation_dtype|config\.view|sub_goals\.\*$|network$|rooms\.config\.domain|config\.(members|diversity|network|sub_goals|agent"
    r"|observation_shape|setting|steps|start|termination|mask_reached|chooser)\.None$|options\.config\.domain\.None"
)
COMPARED_BY = r"sub_goal$|domain$"
UNSEEN = re.compile(  # what no page has
    r"^(?!metrics\.quantities).*\.(unit|interval_over)$|inputs\.\*\.|agents\.\*\.kind|runs\.\*\.(path|ensemble)"
    r"|comparisons\.agents"  # of three runs and more; drawn as those of hypotheses
    r"|ensembles\.\*\.(method|name)|states\.\*\.method|distance\.options|explorer\.baseline|selection\.\*\.name|false_positives|arrays\.saliency.*kinds|attributes\.versions"
    r"|^manifests\.[^.]*\.sha256"  # the sum of the others, made anew
)


def payload(number):
    """What breaks out of a text, an attribute, a script, a style, a comment and a formula, and says so in the title."""
    run = f"document.title='ran{number}.'"
    return f"""'"></text></script></style>--><img src=x onerror={run}><script>{run}</script>$\\q_{{$"""


class Engine:
    """What agents are matched on: states of a layout, with truth."""

    def reachable(self):
        return np.arange(12)

    def images(self, ids):
        return heldout().observations[ids]

    def labels(self, ids):
        return heldout().labels[ids]


@pytest.fixture(scope="module", autouse=True)
def trusted():
    """The data name ladder_run:DOMAIN, code that the user must allow; here it has layouts, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HYPOGOAL_TRUST", "1")
        patch.setattr(LadderDomain, "make_engine", lambda self, *given, **more: Engine())
        patch.setattr(LadderDomain, "rooms_of", lambda self, start: (2, 6))
        yield


def write_states(path, *, rooms):
    """A data file of one labelled group; states of no rooms are those that hypotheses are judged on as a whole."""
    test = heldout()
    origins = {**test.origins, "seen": seen_with(1, test.origins["room"])} if rooms else {}
    part = States(test.observations[:24], test.labels[:24], {})
    collected = Collected(SHAPE, (SUB_GOAL,), part, part, States(test.observations, test.labels, origins))
    write_dataset(path, collected, domain=DOMAIN.name, config={"groups": 1}, seed=0)


def write_agent(folder):
    rows = [(end, 20, 1, 1, 1) for end in range(20, 4_001, 20)]
    write_table(folder / "episodes.csv", Episodes.names(), rows)
    facts = {"layout_seed": 100, "shortest_path": 10, "random_success": 0.1, "random_episodes": 20}
    (folder / "layout.json").write_text(json.dumps(facts), encoding="utf-8")


def write_meta(out, source):
    """An agent that chose among two members."""
    about = {"chooser": "ppo", "termination": "learned", "members": 2, "sub_goals": [SUB_GOAL], "steps": 4_000}
    config = {**about, "domain": DOMAIN.name, "layout_seed": 100, "option_timeout": 50}
    with create(out, kind="meta", config=config, seed=0, inputs=[source]) as draft:
        folder = draft.files
        write_agent(folder)
        rows = [(end, option, 9, 3 + option, 2.5, 1, 8) for end in (2_000, 4_000) for option in (0, 1)]
        write_table(folder / "choices.csv", Choices.names(), rows)
        with create_hdf5(folder / "terminations.h5") as file:
            file["0"] = heldout().observations[:3]
        fill(folder, "meta", config)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """An evaluated run that has one of everything, in folders that are called as folders can be."""
    run = tmp_path_factory.mktemp("runs") / "a<b>c"
    folder = run / FOLDERS[0]
    for name, rooms in (("rooms", True), ("plain", False)):
        write_states(run / f"{FOLDERS[2]}-{name}.h5", rooms=rooms)
        write_members(folder / name, run / f"{FOLDERS[2]}-{name}.h5", 1, "dbat", 0)
    write_options(folder / "options", folder / "rooms", "2-6", 0, executions(0, [3, 4]) + executions(1, [9, 9]), 2)
    write_meta(run / FOLDERS[1], folder / "rooms")
    about = {"agent": "ppo", "setting": "tuned", "steps": 4_000, "layout_seed": 100, "domain": DOMAIN.name}
    with create(run / "ppo", kind="baseline", config=about, seed=0) as draft:
        out = draft.files
        write_agent(out)
        fill(out, "baseline", about)
    evaluate(run, run / "evaluation", quiet=True)
    return run


@pytest.fixture
def changed(run, tmp_path):
    """A copy of the run, to be changed."""
    return shutil.copytree(run, tmp_path / "runs" / run.name)


def metrics_of(run):
    """What ``metrics.json`` of an evaluated run says."""
    return json.loads((run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))


def write_metrics(run, metrics):
    """Have the evaluation say something else, as if it had been written so."""
    path = run / "evaluation" / "metrics.json"
    path.write_text(json.dumps(metrics), encoding="utf-8")
    files = json.loads((path.parent / MANIFEST).read_text(encoding="utf-8"))["files"]
    reseal(path.parent, files=files | {path.name: sha256_of(path)})


class Parsed(HTMLParser):
    """What a browser makes of a page: tags with the names of their attributes, how many scripts, texts and values."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.scripts, self.texts = set(), 0, []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.scripts += tag == "script"
        self.tags |= {tag, *((tag, name) for name, _ in attributes)}
        self.texts += [value for _, value in attributes if value]

    def handle_data(self, data):
        self.texts.append(data)

    def handle_comment(self, data):
        raise AssertionError(data)


def places_of(value, place=()):
    """Where each text of a JSON value is; keys too, where these are a file's own: such a place ends in ``None``."""
    if isinstance(value, str):
        yield place
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from places_of(inner, (*place, index))
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from [(*place, key, None)] if OPEN.search(name_of(place)) else []
            yield from places_of(inner, (*place, key))


def name_of(place):
    return ".".join("*" if isinstance(part, int) else str(part) for part in place)


def replaced(value, numbers, place=()):
    """The JSON value with a payload at each of its places that has a number."""
    if isinstance(value, str):
        return payload(numbers[place]) if place in numbers else value
    if isinstance(value, list):
        return [replaced(inner, numbers, (*place, index)) for index, inner in enumerate(value)]
    if not isinstance(value, dict):
        return value
    keys = {key: (*place, key, None) for key in value}
    return {
        payload(numbers[keys[key]]) if keys[key] in numbers else key: replaced(inner, numbers, (*place, key))
        for key, inner in value.items()
    }


def with_payloads(value, draw, goes_by):
    """The page with a payload in place of every text, which has no more tags, attributes and scripts than before.

    Args:
        value: all texts, as JSON.
        draw: the page of such a value.
        goes_by: names of places at which another text may well be refused, a regular expression; they stay.

    Returns:
        The page, and the names of those places that it does not show.
    """
    honest = Parsed(draw(value))
    every = enumerate(places_of(value))
    numbers = {place: number for number, place in every if not re.search(goes_by, name_of(place))}
    assert len(numbers) > 100
    page = draw(replaced(value, numbers))
    found = Parsed(page)
    assert found.tags <= honest.tags and found.scripts == honest.scripts, found.tags - honest.tags
    shown = {int(number) for number in re.findall(r"ran(\d+)\.", "\n".join(found.texts))}
    return page, {name_of(place) for place, number in numbers.items() if number not in shown}


def drawn(run, texts=None):
    """The page of an evaluated run, as ``report`` draws it, with other ``texts`` in its arrays."""
    found = read_evaluation(run)
    arrays = {name: fixed(json.dumps(own)) for name, own in (texts or {}).items()}
    with fitting(found.source.path):
        return render(Material(found.metrics, {**found.arrays, **arrays}), "1.0")


def everything(run):
    """All texts of an evaluation: those of its numbers and those in its arrays."""
    arrays = read_evaluation(run).arrays
    lists = {name: json.loads(arrays[name].item()) for name in arrays if name.endswith(("/kinds", "/places"))}
    assert len(lists) == 4
    metrics = metrics_of(run)
    metrics["distance"]["shown"][0]["groups"] = "a text in place of a number"
    return {"metrics": metrics, "arrays": lists}


@pytest.fixture(scope="module")
def walked(run, tmp_path_factory):
    """Every text of an evaluation: the page with all payloads, and what it does not show."""
    changed = shutil.copytree(run, tmp_path_factory.mktemp("walked") / run.name)

    def draw(value):
        write_metrics(changed, value["metrics"])
        return drawn(changed, value["arrays"])

    return with_payloads(everything(changed), draw, GOES_BY)


def test_every_text_of_an_evaluation_is_escaped(walked):
    """Spec G2: all of ``metrics.json`` and of the arrays, keys that are a file's too, in texts, attributes, figures."""
    assert not {name for name in walked[1] if not UNSEEN.search(name)}


def test_every_text_that_an_evaluation_is_made_of_is_escaped(changed):
    """Spec G2: all of each kind of manifest and of a data file's attributes, evaluated and drawn."""
    folders = [f"{FOLDERS[0]}/{name}" for name in ("rooms", "plain", "options")] + [FOLDERS[1], "ppo"]  # inputs first
    data = changed / f"{FOLDERS[2]}-rooms.h5"
    with h5py.File(data) as file:
        attributes = {name: file.attrs[name].decode() for name in ("domain", "sub_goals", "config", "versions")}
    value = {
        "manifests": {name: json.loads((changed / name / MANIFEST).read_text(encoding="utf-8")) for name in folders},
        "attributes": {name: json.loads(text) if text[0] in "[{" else text for name, text in attributes.items()},
    }
    before = {name: sha256_of(changed / name) for name in folders} | {data: sha256_of(data)}

    def draw(value):
        with h5py.File(data, "a") as file:
            for name, own in value["attributes"].items():
                file.attrs[name] = fixed(own if isinstance(own, str) else json.dumps(own))
        now = {before[data]: sha256_of(data)}
        for name, manifest in value["manifests"].items():
            inputs = [{**entry, "sha256": now.get(entry["sha256"], entry["sha256"])} for entry in manifest["inputs"]]
            reseal(changed / name, inputs=inputs)
            now[before[name]] = sha256_of(changed / name)
        evaluate(changed, changed / "evaluation", quiet=True, force=True)
        return drawn(changed)

    _, unseen = with_payloads(value, draw, MADE_BY)
    assert not {name for name in unseen if not UNSEEN.search(name)}


def test_every_text_of_compared_runs_is_escaped(changed, run, tmp_path):
    """Spec G2: an evaluation of a stranger's beside one's own."""

    def draw(value):
        write_metrics(changed, value["metrics"])
        return compare([changed, run], tmp_path / "both", force=True).read_text(encoding="utf-8")

    _, unseen = with_payloads({"metrics": everything(changed)["metrics"]}, draw, COMPARED_BY)
    assert unseen.isdisjoint({"metrics.agents.*.name", "metrics.rooms.*.method", "metrics.provenance.artefacts.*.kind"})


def test_ids_and_files_are_named_by_no_stranger(changed):
    """Spec G2: figures have names that are slugs, whatever a ladder is called; two that differ stay two."""
    names = ["a/b", "a b", "\\q", "../../x", payload(1), "$\\frac$", "x" * 300, ".", "\0"]
    metrics = metrics_of(changed)
    (shown,) = metrics["distance"]["shown"]
    metrics["distance"]["shown"] = [{**shown, "ladder": name, "groups": name} for name in names]
    write_metrics(changed, metrics)
    page = (report(changed).path / "index.html").read_text(encoding="utf-8")
    assert "<img src=x" not in page and "<script>document" not in page
    ids = re.findall(r'<figure id="([^"]*)"', page)
    assert len(ids) == len(set(ids)) == len(names) + 5 and all(re.fullmatch(r"[\w-]+", one) for one in ids)
    files, _ = draw_figures(changed, changed / "figures")
    assert len(files) > len(names) and {file.parent for file in files} == {changed / "figures"}
    assert "<img" not in (changed / "figures" / "captions.md").read_text(encoding="utf-8")


def other_paths(metrics):
    """An evaluation that is not of one piece."""
    for one in metrics["ensembles"]:
        one["path"] += "-other"
    metrics["agents"] = metrics["rooms"] = metrics["hypotheses"] = []


def another_ensemble(metrics):
    metrics["explorer"]["ensemble"] += "-other"
    metrics["agents"] = metrics["rooms"] = metrics["hypotheses"] = []


def many_members(metrics):
    """A billion of them would be a billion choices on the page."""
    for one in metrics["ensembles"]:
        one["members"] = 10**7


def name_that_is_none(name, metrics):
    metrics["selection"][0]["runs"][0]["sub_goals"][0]["sub_goal"] = name


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *((change, "does not fit this hypogoal, or is damaged") for change in (other_paths, another_ensemble)),
        (many_members, "does not fit this hypogoal, or is damaged"),
        *((partial(name_that_is_none, name), "has an invalid name") for name in (r"\q", "a/b", "<b>", "=1+1", 3)),
    ],
)
def test_an_evaluation_that_cannot_be_is_refused(changed, change, words):
    """Spec G2: one line, whichever of its parts says so first."""
    metrics = metrics_of(changed)
    change(metrics)
    write_metrics(changed, metrics)
    refuses(words, "report", changed)


def test_every_command_that_reads_an_evaluation_refuses_it(changed, run, tmp_path):
    """Spec G2: the rule for names of sub-goals holds wherever they are read."""
    metrics = metrics_of(changed)
    name_that_is_none("<b>", metrics)
    write_metrics(changed, metrics)
    refuses("has an invalid name", "report", changed, "--figures", tmp_path / "out")
    refuses("has an invalid name", "compare", changed, run, "--out", tmp_path / "out")


OWN = {
    "rooms_of": (
        (lambda self, start: 1 / 0, "the domain's rooms_of raised ZeroDivisionError: division by zero"),
        (lambda self, start: None, "the domain's rooms_of raised TypeError"),
        (lambda self, start: (1, -1), "the domain's rooms_of gave (1, -1)"),
    ),
    "picture": ((lambda self, room: "x", "the domain's picture gave <U1 ()"),),
    "pixel": ((lambda self, positions: 1 / 0, "the domain's pixel raised ZeroDivisionError: division by zero"),),
}


@pytest.mark.parametrize(("name", "given", "words"), [(name, *pair) for name, pairs in OWN.items() for pair in pairs])
def test_own_rooms(changed, name, given, words, monkeypatch):
    """Spec G2: a domain's own pictures of its rooms: whose code, what and where."""
    monkeypatch.setattr(LadderDomain, name, given)
    line = refuses(words, "evaluate", changed, "--force", "-q")
    assert "test_strange_texts.py, line" in line


SCRIPT, IMAGE = "<script>document.title = 'ran'</script>", "<img src=x onerror=\"document.title = 'ran'\">"


@pytest.mark.browser
@needs_browser
def test_nothing_of_a_stranger_runs(walked, tmp_path):
    """Spec G2: with payloads everywhere nothing runs; where an escape is missing, the policy stops what would."""
    page, _ = walked
    bare, removed = re.subn(r"<meta http-equiv[^>]*>", "", page)
    assert removed == 1
    title = f"hypogoal: {payload(0)} – hypogoal"
    for text in (page, bare):
        document, said = loaded(text, tmp_path)
        assert title_of(document) == title and not said
        assert 'class="tile"' in document, "the page's own script runs"
    slip = f"{SCRIPT}{IMAGE}</body>"
    document, said = loaded(page.replace("</body>", slip), tmp_path)
    assert title_of(document) == title and len(said) == 3, said
    assert title_of(loaded(bare.replace("</body>", slip), tmp_path)[0]) == "ran", "the page without its policy"
