"""A process that loads the web page: silent WebSockets, or pages that plot 20 registers."""

from __future__ import annotations

import argparse
import asyncio
import math

from common import tell, wait_for_parent
from web_page import follow, silent


async def load(address: str, silent_ones: int, pages: int) -> None:
    async with silent(address, silent_ones):
        paths = ["cell/Stamp", *(f"cell/Rest/{number}" for number in range(19))]
        tasks = [asyncio.create_task(follow(address, paths, math.inf)) for _ in range(pages)]
        tell("ready")
        await asyncio.to_thread(wait_for_parent)
        for task in tasks:
            if task.done():
                task.result()
            task.cancel()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("address")
    parser.add_argument("--silent", type=int, default=0)
    parser.add_argument("--pages", type=int, default=0)
    given = parser.parse_args()
    asyncio.run(load(given.address, given.silent, given.pages))


if __name__ == "__main__":
    main()
