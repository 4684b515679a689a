"""`drnav worlds` and `drnav dataset`: pictures of worlds, and training frames."""

import sys
from pathlib import Path

from drnav_jax import dataset, gallery, report, sources
from drnav_jax.cli import process
from drnav_jax.cli.flags import Dataset, Worlds
from drnav_jax.cli.terminal import Bar, stdout_kept
from drnav_jax.scripts import INTERRUPTED


def show(args: Worlds) -> int:
    """Draw; the exit code.

    Raises:
        ValueError: On a user's mistake.
        OSError: If a file cannot be written.
    """
    if args.gallery == (args.world is not None):
        raise ValueError("give either --world FAMILY:SEED or --gallery.")
    out = args.out or Path("results") / "worlds"
    if args.gallery:
        file = gallery.gallery(out / "gallery.png", dataset.families_of(args.split), args.seed, args.split)
    else:
        source = sources.Source(world=args.world, split=args.split)
        (scene,) = sources.load(source, args.robot_radius, args.robot_radius)
        name = scene.name.replace(":", "-")
        file = gallery.picture(out / f"{name}.png", scene, args.robot_radius, args.seed)
    print(f"drnav: wrote {file}", file=sys.stderr)
    return 0


def gather(args: Dataset) -> int:
    """Write what is missing of a dataset; the exit code.

    Raises:
        ValueError: On a user's mistake, or if the folder holds something else.
        OSError: If a file cannot be written.
    """
    families = None if args.families is None else tuple(name.strip() for name in args.families.split(","))
    spec = dataset.spec_of(args.frames, args.split, args.seed, families, args.litter, args.charted)
    bar = Bar("dataset", args.frames, "frames")
    try:
        with stdout_kept(args.json):
            manifest = dataset.write(args.out, spec, workers=args.workers, prepare=process.prepare, progress=bar)
    except KeyboardInterrupt:
        print(f"drnav: interrupted; run the same command again to go on in {args.out}/", file=sys.stderr)
        return INTERRUPTED
    finally:
        bar.close()
    file = dataset.page(args.out)
    print(report.dumps(dataset.outline(manifest)) if args.json else dataset.table(manifest))
    print(f"drnav: wrote {args.out}/" + (f", samples in {file}" if file else ""), file=sys.stderr)
    return 0
