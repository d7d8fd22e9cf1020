"""The paper's figures of a run as files of their own (Spec F7)."""

from html import escape
from pathlib import Path

from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text, replacing
from hypogoal.evaluation.page import Material
from hypogoal.evaluation.plots import slug, to_file
from hypogoal.evaluation.questions import paper_figures
from hypogoal.evaluation.run import fitting, read_evaluation

KINDS = ("svg", "pdf", "png")


def draw_figures(run: Path, folder: Path, kind: str = "svg", *, force: bool = False) -> tuple[list[Path], list[str]]:
    """Draw the paper's figures, those that the run has artefacts for, as files of their own, and ``captions.md``.

    Returns the files written, and a line for each of Figures 2 to 9 that cannot be drawn, with what it needs. Another
    ``kind`` than those in ``KINDS``, a run that was not evaluated, or a file that is there is a ``UserError``.
    """
    if kind not in KINDS:
        raise UserError("no such format of figures", kind, f"Choose one of {', '.join(KINDS)}.")
    evaluation = read_evaluation(run)
    with fitting(evaluation.source.path):
        drawn, missing = paper_figures(Material(evaluation.metrics, evaluation.arrays))
    files = {folder / f"{slug(drawing.stem)}.{kind}": drawing for drawing in drawn}
    captions = folder / "captions.md"
    for path in (*files, captions):
        if path.exists() and not force:
            raise UserError("exists already", path, "Give --force to replace it, or choose another folder.")
    folder.mkdir(parents=True, exist_ok=True)
    text = []
    for path, drawing in files.items():
        if drawing.figure is not None:
            with replacing(path) as fresh:
                fresh.write_bytes(to_file(drawing.figure, drawing.stem, kind))
        caption = " ".join(filter(None, [drawing.caption, drawing.runs]))
        text.append(f"## {path.name}\n\n{escape(caption, quote=False)}\n")
    text += [f"{line}\n" for line in missing]
    replace_text(captions, "\n".join(text))
    return [*files, captions], missing
