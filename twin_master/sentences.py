"""Why the twin refuses what it is given: one file of sentences, filled in here."""

from reporting.sentences import Sentences

said = Sentences(__file__).said
