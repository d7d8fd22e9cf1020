"""Functions whose arguments or locals have vague names: ``python -m tests.vague_names`` fails above a limit."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "hypogoal"
VAGUE = frozenset((
    "told", "found", "about", "given", "here", "there", "own", "of", "made", "known", "said", "asked", "what", "one",
    "yes", "chance", "thing", "things", "stuff",
))  # fmt: skip
LIMIT = 0.01
Function = ast.FunctionDef | ast.AsyncFunctionDef


def vague_names(function: Function) -> set[str]:
    """The vague names among a function's arguments and local variables; those of functions within it do not count."""
    nodes = [*ast.iter_child_nodes(function.args), *_within(function)]
    names = {node.arg for node in nodes if isinstance(node, ast.arg)}
    names |= {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    return names & VAGUE


def _within(function: Function) -> Iterator[ast.AST]:
    """The nodes of a function's body, without those of functions and classes within it."""
    waiting: list[ast.AST] = [*function.body]
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, Function | ast.ClassDef):
            waiting += ast.iter_child_nodes(node)


def main() -> int:
    """Print the share, and above the limit each function; 1 where the share is above the limit, else 0."""
    total, vague = 0, []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, Function):
                total += 1
                names = sorted(vague_names(node))
                vague += [f"  {path.relative_to(PACKAGE)}: {node.name}: {', '.join(names)}"] if names else []
    print(f"vague names: {len(vague)} of {total} functions, at most {LIMIT:.0%}")
    if len(vague) <= LIMIT * total:
        return 0
    print(*vague, sep="\n")
    return 1


if __name__ == "__main__":
    sys.exit(main())
