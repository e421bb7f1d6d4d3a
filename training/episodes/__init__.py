"""Episodes of scripted policies: runner, metrics, tables, figures and videos."""
