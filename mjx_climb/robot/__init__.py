"""What a robot is: its constants, and the models that come with the program."""
