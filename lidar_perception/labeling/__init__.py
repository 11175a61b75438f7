"""Labels of a drive made by a person: the state, its journal, what is proposed, and the server."""
