"""Functions whose arguments or locals have vague names: ``python -m tests.vague_names`` fails above a limit."""

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "hypogoal"
VAGUE = frozenset((
    "told", "found", "about", "given", "here", "there", "own", "of", "made", "known", "said", "asked", "what", "one",
    "yes", "chance", "thing", "things", "stuff",
))  # fmt: skip
LIMIT = 0.01
WORST = 10
Function = ast.FunctionDef | ast.AsyncFunctionDef


def functions(tree: ast.AST) -> Iterator[Function]:
    """Every function and method of a module, nested ones too."""
    return (node for node in ast.walk(tree) if isinstance(node, Function))


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


def count(package: Path) -> tuple[int, Counter[str]]:
    """The number of functions in a package, and of those with a vague name, by file."""
    total, vague = 0, Counter[str]()
    for path in sorted(package.rglob("*.py")):
        for function in functions(ast.parse(path.read_text(encoding="utf-8"))):
            total += 1
            vague[path.relative_to(package).as_posix()] += bool(vague_names(function))
    return total, vague


def main(package: Path = PACKAGE, limit: float = LIMIT) -> int:
    """Print the share and the worst files; 1 where the share is above the limit, else 0."""
    total, vague = count(package)
    share = vague.total() / max(total, 1)
    print(f"vague names: {vague.total()} of {total} functions ({share:.1%}), at most {limit:.0%}")
    if share <= limit:
        return 0
    for path, number in vague.most_common(WORST):
        print(f"  {number:3} in {path}")
    return 1


if __name__ == "__main__":
    sys.exit(main())
