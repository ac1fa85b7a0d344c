"""Why options of commands are refused: one file of sentences, filled in here."""

from reporting.sentences import Sentences

said = Sentences(__file__).said
