"""Tables of a campaign: comma-separated text with one header line, in the campaign's folder."""

from pathlib import Path

from discrepancy.errors import CampaignDataError, CampaignFileError
from reporting import table_file
from reporting.table_file import TableErrors, TextTable

TABLE_ERRORS = TableErrors(layout=CampaignFileError, value=CampaignDataError)
"""What a table of a campaign raises."""


def read_table(folder: Path, name: str) -> TextTable:
    """Read a table of a campaign's folder; sentences about its content name it without the folder.

    Raises
    ------
    CampaignFileError
        The file is missing, is not UTF-8, has no header or rows, names a column twice, or a row has another
        number of cells than the header.
    """
    path = folder / name
    if not path.exists():
        there = sorted(item.name for item in folder.glob("*.csv"))
        raise CampaignFileError(
            f"There is no file {name} in {folder}; the tables there are {', '.join(there) or 'none'}."
        )
    return table_file.read_table(path, TABLE_ERRORS, name=name)
