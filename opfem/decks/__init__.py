"""Abaqus and CalculiX decks in and out: `read_inp`, `write_inp`, and CalculiX' results."""

from .calculix import read_dat as read_dat, read_frd as read_frd
from .cards import DeckError as DeckError
from .deck import Deck as Deck
from .reading import read_inp as read_inp
from .writing import write_inp as write_inp
