"""The paper's figures as files of their own."""

from pathlib import Path

from hypogoal.core.errors import UserError
from hypogoal.core.files import replacing
from hypogoal.evaluation import page
from hypogoal.evaluation.plots import UNDATED, slug, to_file
from hypogoal.evaluation.questions import answers
from hypogoal.evaluation.run import read_evaluation


def draw_figures(
    run: Path,
    folder: Path,
    kind: str = "svg",
    *,
    force: bool = False,
) -> tuple[list[Path], list[str]]:
    """Draw the paper's figures that the run has artefacts for as files of their own, and write ``captions.md``.

    Returns the files written, and a line for each of Figures 2 to 9 that cannot be drawn, with what it needs. Raises
    ``UserError`` if the run was not evaluated, if ``kind`` is none of svg, pdf and png, or if a file exists and
    ``force`` is not given.
    """
    if kind not in UNDATED:
        raise UserError("no such format of figures", kind, f"Choose one of {', '.join(UNDATED)}.")
    results = read_evaluation(run)
    figures = {}
    for context in answers(results):
        words = page.words_of(context)
        for drawn in context["figures"]:
            caption = words.caption(drawn).unescape().split()
            figures[drawn.name] = to_file(drawn.figure, kind), " ".join(caption)
    missing = page.lines_of("needed.txt", drawn=[name.partition("-")[0] for name in figures])
    contents = {}
    texts = []
    for name, (content, caption) in sorted(figures.items()):
        path = folder / f"{slug(name)}.{kind}"
        contents[path] = content
        texts.append(f"## {path.name}\n\n{caption}")
    text = "\n\n".join([*texts, *missing])
    contents[folder / "captions.md"] = f"{text}\n".encode()
    for path in contents:
        if path.exists() and not force:
            raise UserError("exists already", path, "Give --force to replace it, or choose another folder.")
    folder.mkdir(parents=True, exist_ok=True)
    for path, content in contents.items():
        with replacing(path) as fresh:
            fresh.write_bytes(content)
    return [*contents], missing
