"""Work items to workers and back: a scheduler that is a pure state machine, and the engines that feed it."""
