"""What searches return, as data: each kind of result, with its files; nothing here walks."""
