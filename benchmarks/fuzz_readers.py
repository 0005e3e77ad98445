"""Coverage-guided fuzzing of one reader: whatever the bytes, a recording or one clear error comes of them.

    pip install -e '.[test,fuzz]'
    python benchmarks/fuzz_readers.py usd2 -max_total_time=60
    python benchmarks/fuzz_readers.py usd2 crash-0123...         # a single input again

Formats are those of tests/crazyem/reader_seeds.py, whose small valid file is what mutations start from; options and
files after the format are libFuzzer's. An input is opened whole and in parts. Anything but a CrazyemError ends the run,
as do 10 s or 2 GB for an input; the traceback and the input in hex are printed, and libFuzzer keeps the input in a file
in the present folder. Only crazyem.recordings is instrumented.
"""

import importlib
import pkgutil
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

TESTS = Path(__file__).parents[1] / "tests" / "crazyem"
COMPILED = "crazyem.recordings.mcap.kernel"  # compiled by numba, so it must not be instrumented
SECONDS = 10


def instrumented() -> None:
    """Import every reader with probes at its branches."""
    import atheris

    importlib.import_module("crazyem.signals.vocabulary")
    importlib.import_module("crazyem.estimation.result")
    with atheris.instrument_imports(include=["crazyem.recordings"], exclude=[COMPILED]):
        package = importlib.import_module("crazyem.recordings")
        for module in pkgutil.walk_packages(package.__path__, "crazyem.recordings."):
            importlib.import_module(module.name)


def target(path: Path) -> Callable[[bytes], None]:
    """The function that is called with every input; `path` is where the input lies for the reader."""
    from crazyem.errors import CrazyemError
    from crazyem.recordings import open_recording
    from crazyem.recordings.registry import can_be_parted, open_parts

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        for read in (lambda: [open_recording(path)], lambda: open_parts(path, seconds=0.05)):
            try:
                for recording in read():
                    assert all(finding.text for finding in recording.findings)
                    assert all(a.time.size == len(a.value) == a.order.size for a in recording.signals.values())
                if not can_be_parted(path):
                    return
            except CrazyemError as error:
                if "\n" in str(error):
                    raise ValueError(f"more than a sentence: {error}") from error
            except Exception:
                traceback.print_exc()
                print(f"input: {data.hex()}", file=sys.stderr, flush=True)
                raise

    return attempt


def main() -> None:
    """Command line."""
    try:
        import atheris
    except ImportError:
        sys.exit("atheris is not installed: pip install -e '.[test,fuzz]' (it needs Linux or macOS).")
    if len(sys.argv) < 2 or sys.argv[1].startswith("-"):
        sys.exit(__doc__)
    name = sys.argv.pop(1)
    instrumented()
    sys.path.insert(0, str(TESTS))
    from reader_seeds import seeds

    with tempfile.TemporaryDirectory() as folder:
        made = seeds(Path(folder))
        if name not in made:
            sys.exit(f'"{name}" is none of the formats: {", ".join(made)}.')
        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        (corpus / "seed").write_bytes(made[name])
        given = [word for word in sys.argv[1:] if not word.startswith("-")]
        options = [f"-timeout={SECONDS}", f"-max_len={2 * len(made[name]) + 64}", *sys.argv[1:]]
        attempt = target(Path(folder) / "input.bin")
        attempt(made[name])  # load everything first, so that loading does not count for an input
        atheris.Setup([sys.argv[0], *options, *([] if given else [str(corpus)])], attempt)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
