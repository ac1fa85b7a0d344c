"""Files of a campaign that are made from published measurements."""

from typing import NamedTuple

from reporting.formats.toml_file import TomlTable


class RigFiles(NamedTuple):
    """Files of a campaign that are made from published measurements.

    Attributes
    ----------
    tables : dict of str to str
        The texts of the tables by the names of their files.
    campaign_keys : dict
        The keys of `campaign.toml` in addition to the shipped ones: trials, channels and remarks.
    """

    tables: dict[str, str]
    campaign_keys: TomlTable
