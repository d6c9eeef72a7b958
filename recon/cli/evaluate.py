"""`recon evaluate`: compare results with ground truth."""

from __future__ import annotations

import typer

from recon.cli.evaluate_disparity import disparity
from recon.cli.evaluate_map import map_
from recon.cli.evaluate_middlebury import middlebury
from recon.cli.evaluate_occupancy import occupancy
from recon.cli.evaluate_trajectory import trajectory

app = typer.Typer(no_args_is_help=True, help="Compare results with ground truth.")
app.command()(middlebury)
app.command()(disparity)
app.command()(trajectory)
app.command()(occupancy)
app.command("map")(map_)
