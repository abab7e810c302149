"""Tables of the `reproduce` command."""

from typing import TYPE_CHECKING

from rich.table import Table

from gripper_force.cli.console import out

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gripper_force.qualification.paper import paper_tables as paper


def paper_tables(tables: "Sequence[paper.Table]", figures: "Mapping[str, str]") -> None:
    """Prints the paper's tables, and the files of its figures."""
    from gripper_force.qualification.paper.paper_tables import cell_text

    for paper_table in tables:
        table = Table(*paper_table.columns, title=paper_table.title, title_justify="left", box=None)
        for row in paper_table.rows:
            table.add_row(*map(cell_text, row))
        out.print(table)
        out.print()
    for name, path in figures.items():
        out.print(f"{name}: {path}", soft_wrap=True)
