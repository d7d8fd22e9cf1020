"""Draw how data flow from stage to stage, from what each stage's file declares: ``python docs/stages.py``.

A stage's inputs are its arguments that name a kind of artefact, its output is the kind that it asks a draft for.
"""

import ast
from pathlib import Path

DOCS = Path(__file__).parent
STAGES = DOCS.parent / "hypogoal" / "stages"
PLACES = {  # of each kind of artefact: column, row
    "data": (0, 0),
    "ensemble": (1, 0),
    "options": (2, 0),
    "meta": (3, 0),
    "baseline": (3, 1),
    "run": (4, 0),
    "evaluation": (5, 0),
    "report": (6, 0),
}
COLUMN, ROW, WIDTH, HEIGHT, TOP = 150, 80, 92, 34, 70
STYLE = "background:#fff;font:13px sans-serif"


def declared(path: Path) -> tuple[str, list[str], str] | None:
    """A stage's name, the kinds it reads and the kind it writes; None if the file is no stage."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for function in tree.body:
        if isinstance(function, ast.FunctionDef) and function.decorator_list:
            arguments = [argument.arg for argument in (*function.args.args, *function.args.kwonlyargs)]
            reads = [name for name in arguments if name in PLACES]
            return function.name.replace("_", "-"), reads, _written_by(function)
    return None


def _written_by(function: ast.FunctionDef) -> str:
    for call in ast.walk(function):
        if isinstance(call, ast.Call) and ast.unparse(call.func) in ("call.draft", "call.training"):
            return ast.unparse(call.args[0]).strip("'").lower()
    raise ValueError(f"{function.name} writes nothing")


def _centre(kind: str) -> tuple[int, int]:
    column, row = PLACES[kind]
    return 60 + column * COLUMN, TOP + row * ROW


def _arrow(begin: str, end: str) -> str:
    """A straight line between neighbours, else a bow above them, to the lower row below them."""
    x, y = _centre(begin)
    to_x, to_y = _centre(end)
    middle = (x + to_x) // 2
    if PLACES[end][0] - PLACES[begin][0] == 1:
        return _line(f"M{x + WIDTH // 2} {y} L{to_x - WIDTH // 2 - 4} {to_y}")
    if to_y > y:
        return _line(f"M{x + 36} {y + HEIGHT // 2} Q{x + 80} {to_y} {to_x - WIDTH // 2 - 4} {to_y}")
    return _line(f"M{x + 20} {y - HEIGHT // 2} Q{middle} {y - 80} {to_x - 20} {to_y - HEIGHT // 2 - 4}")


def _line(path: str) -> str:
    return f'<path d="{path}" marker-end="url(#head)"/>'


def _text(x: int, y: int, words: str) -> str:
    return f'<text x="{x}" y="{y}">{words}</text>'


def drawn() -> str:
    """The picture, an SVG."""
    lines, texts = [], []
    for kind in PLACES:
        x, y = _centre(kind)
        lines.append(f'<rect x="{x - WIDTH // 2}" y="{y - HEIGHT // 2}" width="{WIDTH}" height="{HEIGHT}" rx="6"/>')
        texts.append(_text(x, y + 5, kind))
    for path in sorted(STAGES.glob("*.py")):
        stage = declared(path)
        if stage is None:
            continue
        name, reads, kind = stage
        x, y = _centre(kind)
        texts.append(_text(x, y + HEIGHT // 2 + 18, name))
        for read in reads:
            if read != kind:
                lines.append(_arrow("evaluation" if name == "report" else read, kind))
    for kind in ("meta", "baseline"):  # a run is a folder of all of them
        lines.append(_arrow(kind, "run"))
    head = '<marker id="head" markerWidth="8" markerHeight="8" refX="4" refY="4" orient="auto">'
    width, height = 60 + len(PLACES) * COLUMN - 2 * COLUMN + 60, TOP + ROW + 50
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" style="{STYLE}">',
            f'<defs>{head}<path d="M0 0 L8 4 L0 8" fill="#555"/></marker></defs>',
            '<g fill="none" stroke="#555">',
            *lines,
            '</g><g fill="#111" text-anchor="middle">',
            *texts,
            "</g></svg>",
            "",
        ]
    )


if __name__ == "__main__":
    (DOCS / "stages.svg").write_text(drawn(), encoding="utf-8")
