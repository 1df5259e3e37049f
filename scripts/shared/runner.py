"""Run one of the commands in a folder of scripts: each module with a function `main` is a command.

A command's `main` takes its options as keywords and returns an exit status or None. `OPTIONS` has the
arguments of `add_argument` by name. A command with a constant `DOCUMENT` writes a block of that page: its
`main` also takes a `page`, and there is an option `--output`.
"""

import argparse
import ast
import importlib
import sys
from pathlib import Path

from shared.document import DOCS, Page

SCRIPTS = Path(__file__).parents[1]


class _Help(argparse.RawDescriptionHelpFormatter, argparse.ArgumentDefaultsHelpFormatter):
    pass


def commands(folder: str) -> dict[str, str]:
    """Return the summary of each command by name, without importing any."""
    summaries = {}
    for path in sorted((SCRIPTS / folder).glob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body):
            summaries[path.stem] = (ast.get_docstring(tree) or "").partition("\n")[0]
    return summaries


def run(folder: str, description: str | None) -> int:
    """Run the command that `sys.argv` names, or list the commands; return the exit status."""
    parser = argparse.ArgumentParser(description=description, formatter_class=_Help)
    names = parser.add_subparsers(metavar="NAME", dest="name")
    chosen, module = sys.argv[1:2], None
    for name, summary in commands(folder).items():
        command = names.add_parser(name, help=summary, description=summary, formatter_class=_Help)
        if chosen == [name]:
            try:
                module = importlib.import_module(f"{folder}.{name}")
            except ModuleNotFoundError as error:  # a package that only this command needs
                missing = f"needs {error.name}, which is not installed; docs/install.md has the extras"
                command.epilog = f"The command {missing}. Its options show when it is."
                if {"-h", "--help"} & set(sys.argv[2:]):
                    command.print_help()
                    return 0
                command.exit(2, f"{folder}/{name}.py {missing}\n")
            command.description = module.__doc__
            for flag, settings in getattr(module, "OPTIONS", {}).items():
                command.add_argument(flag, **settings)
            if hasattr(module, "DOCUMENT"):
                command.description += f"\nWrites a block of docs/{module.DOCUMENT}."
                command.add_argument("--output", type=Path, default=DOCS, help="folder of the written files")
    options = vars(parser.parse_args())
    name = options.pop("name")
    if module is None:
        parser.print_usage()
        print(*(f"  {name:18}{summary}" for name, summary in commands(folder).items()), sep="\n")
        return 0
    if hasattr(module, "DOCUMENT"):
        command_name = f"{Path(sys.argv[0]).name} {name}"
        options["page"] = Page(module.DOCUMENT, command_name, options.pop("output"))
    return int(module.main(**options) or 0)
