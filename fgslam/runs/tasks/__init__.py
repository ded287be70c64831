"""What each kind of experiment does: one module a task, and its parts next to it."""
