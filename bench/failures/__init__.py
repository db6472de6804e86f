"""Known failures of the methods, each a number that can be measured again; every method has a file of its name."""
