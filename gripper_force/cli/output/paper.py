"""The paper's tables, made again."""

from typing import Any

from rich.table import Table

from gripper_force.cli.console import out


def paper_tables(r: dict[str, Any]) -> None:
    """The paper's tables, and where its figures are."""
    from gripper_force.qualification.paper.paper_tables import show

    for made in r["tables"]:
        table = Table(*made.columns, title=made.title, title_justify="left", box=None)
        for row in made.rows:
            table.add_row(*map(show, row))
        out.print(table)
        out.print()
    for name, path in r["figures"].items():
        out.print(f"{name}: {path}", soft_wrap=True)
