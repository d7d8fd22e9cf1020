"""The paper's figures of a run as files of their own (Spec F7)."""

from pathlib import Path

from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text, replacing
from hypogoal.evaluation.plots import KINDS, slug, to_file
from hypogoal.evaluation.questions import answers, captions, not_drawn
from hypogoal.evaluation.run import evaluation_of, fitting, read_evaluation


def draw_figures(run: Path, folder: Path, kind: str = "svg", *, force: bool = False) -> tuple[list[Path], list[str]]:
    """Draw the paper's figures, those that the run has artefacts for, as files of their own, and ``captions.md``.

    Returns the files written, and a line for each of Figures 2 to 9 that cannot be drawn, with what it needs. Another
    ``kind`` than those in ``KINDS``, a run that was not evaluated, or a file that is there is a ``UserError``.
    """
    if kind not in KINDS:
        raise UserError("no such format of figures", kind, f"Choose one of {', '.join(KINDS)}.")
    results = read_evaluation(run)
    with fitting(evaluation_of(run).path):
        figures = captions(answers(results, drawn=True))
        missing = not_drawn(figures)
    files = {folder / f"{slug(name)}.{kind}": name for name in figures}
    for path in (*files, folder / "captions.md"):
        if path.exists() and not force:
            raise UserError("exists already", path, "Give --force to replace it, or choose another folder.")
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for path, name in sorted(files.items()):
        figure, caption = figures[name]
        with replacing(path) as fresh:
            fresh.write_bytes(to_file(figure.figure, kind))
        lines.append(f"## {path.name}\n\n{caption}\n")
    replace_text(folder / "captions.md", "\n".join([*lines, *(f"{line}\n" for line in missing)]))
    return [*sorted(files), folder / "captions.md"], missing
