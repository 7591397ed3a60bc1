"""The results of searches, as data: each kind of result, with its files; nothing here walks."""
