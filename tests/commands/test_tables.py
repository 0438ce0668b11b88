"""The paper's tables on a terminal."""

import io

from rich.console import Console

from gnio_jax.commands.tables import MOST_COLUMNS, _table
from gnio_jax.evaluation import tabulate


def shown(header, rows):
    file = io.StringIO()
    table = _table(tabulate.markdown(header, rows).splitlines())
    Console(file=file, width=80).print(table)
    return [line.split() for line in file.getvalue().splitlines() if line.strip()]


def test_a_table_of_few_columns_stands_as_it_is():
    lines = shown(["", "ATE (m)", "gate"], [["tlio", "4.70", "a | b"], ["gnio", "5.44", ""]])
    assert lines[0] == ["ATE", "(m)", "gate"]
    assert lines[2:] == [["tlio", "4.70", "a", "|", "b"], ["gnio", "5.44"]]


def test_a_table_of_many_columns_is_turned():
    header = ["", *(f"metric{number}" for number in range(MOST_COLUMNS))]
    rows = [["tlio", *map(str, range(MOST_COLUMNS))], ["gnio", *"abcdefg"]]
    lines = shown(header, rows)
    assert lines[0] == ["tlio", "gnio"]
    assert lines[2:] == [[f"metric{n}", str(n), "abcdefg"[n]] for n in range(MOST_COLUMNS)]
