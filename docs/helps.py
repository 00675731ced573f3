# SPDX-License-Identifier: Apache-2.0

"""Print the help of executables, by name, as JSON: one process loads for all what each needs."""

from contextlib import redirect_stdout, suppress
from importlib.metadata import entry_points
from io import StringIO
import json
import sys


def help_of(name: str) -> str:
    """Return what `name --help` prints."""
    (entry,) = entry_points(group='console_scripts', name=name)
    main = entry.load()
    sys.argv = [name, '--help']
    with redirect_stdout(StringIO()) as out, suppress(SystemExit):
        main()
    return out.getvalue()


if __name__ == '__main__':
    print(json.dumps({name: help_of(name) for name in sys.argv[1:]}))
