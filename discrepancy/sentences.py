"""What the workflow says of faults, verdicts and experiments: one file of sentences, filled in here."""

from reporting.sentences import Sentences

_OF_THE_WORKFLOW = Sentences(__file__)
SENTENCES, said = _OF_THE_WORKFLOW.tables, _OF_THE_WORKFLOW.said
"""Sentences by table and name; a sentence by "table.name" with its values."""
