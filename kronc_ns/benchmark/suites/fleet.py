"""The suite of the fleet: throughput, overheads and growth of `kronc fleet`, and what disturbances cost."""

from functools import partial

from kronc_ns.benchmark.suites import fleet_measures as measures
from kronc_ns.benchmark.suites.rows import Limit, Row

_WALK = "walk 480x270, 60 views, 1 px, keypoints and no images"


def fleet_rows(scenes: int) -> list[Row]:
    """All rows; ``scenes`` is how many captures the rows of throughput and disturbances have at most."""
    captures, disturbed = min(scenes, 2000), min(scenes, 500)
    return [
        Row(
            "throughput on two nodes of one CPU",
            f"{captures} captures, {_WALK}, no reports; over the same folders read, solved by `solve_scenes` with two "
            "threads and written in one process; the start of the nodes is not counted, that of their workers is",
            1,
            partial(measures.throughput, captures=captures),
            (Limit("over_solve_scenes", at_least=0.8),),
            {"mean": ("captures_per_s", "solve_scenes_captures_per_s", "cluster_start_s")},
        ),
        Row(
            "overhead of a capture with images",
            "6 captures of 6 rendered views, keypoints given, one after the other on one node, the start of its worker "
            "included; a capture's share, beyond `kronc-process-data` in whole, and beyond its work in a warm process",
            1,
            measures.overhead,
            (Limit("overhead_s", at_most=0.3),),
            {"mean": ("fleet_s", "alone_s", "over_warm_s")},
        ),
        Row(
            "killed workers and a killed driver",
            f"{disturbed} captures, {_WALK}, two nodes; every 10 s a worker is killed, once the driver; then --resume",
            1,
            partial(measures.disturbed, captures=disturbed),
            (
                Limit("lost", "total", at_most=0.0),
                Limit("twice", "total", at_most=0.0),
                Limit("other_results", "total", at_most=0.0),
            ),
            {"mean": ("workers_killed", "seconds")},
        ),
        Row(
            "listing and planning 1,000,000 captures",
            "a synthetic listing of an object store, in bundles of the size that captures of 0.1 s make",
            1,
            measures.planning,
            (Limit("seconds", at_most=60.0), Limit("megabytes", at_most=1000.0)),
        ),
        Row(
            "memory of the driver",
            "100 and 10,000 captures whose outcomes are made up, with table and page; peak of resident memory, each in "
            "a process of its own",
            1,
            measures.driver_memory,
            (Limit("megabytes_more", at_most=100.0),),
            {"mean": ("megabytes_100", "megabytes_10000")},
        ),
        Row(
            "page of 10,000 captures",
            "made-up rows; from the call to the first rows on the screen, in headless chromium",
            1,
            measures.page,
            (Limit("opens_s", at_most=3.0),),
            {"mean": ("megabytes",)},
        ),
        Row(
            "what grows with a million captures",
            "made-up rows: parquet parts and bytes, seconds to write and to read the table, to look at a million rows",
            1,
            measures.growth,
            (),
            {"mean": ("parts", "megabytes", "write_s", "open_s", "page_s", "page_megabytes")},
        ),
    ]
