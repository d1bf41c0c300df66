"""How good a fix can be: the bound, what is observable, maps of both."""
