"""The `bayessim` command: one file per subcommand."""
