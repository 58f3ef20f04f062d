"""Two hundred bootstrap draws on the workers of a cluster: a Dask cluster, or MPI.

How uncertain is the position of the tool? The bootstrap, refits of rows drawn with replacement, estimates this without a
model of the noise. Each refit is a task; the fit is sent to each worker once, and the draws are the same on any workers. Run
it as

    python examples/on_a_cluster.py                                           # a Dask cluster of two processes, started here
    python examples/on_a_cluster.py --dask tcp://10.0.0.5:8786                # one that runs: dask scheduler, dask worker
    mpiexec -n 3 python -m mpi4py.futures examples/on_a_cluster.py --mpi      # two workers and this script

Workers need the same version of pincal (``pip install 'pincal[cluster]'`` brings Dask). With MPI on several machines all
have to see the folder of temporary files: set TMPDIR. ``pincal calibrate`` and ``pincal discover`` take ``--dask ADDRESS``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib.util import find_spec

import numpy as np

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.simulate import Instrument, TrueMachine, plan_poses
from pincal.simulate.typical import draw_typical_errors

NOISE, POSES = 5e-5, 120  # standard deviation of one coordinate [m], number of measured poses


@contextmanager
def executor_of(dask: str | None, *, mpi: bool) -> Iterator[Executor]:
    """Yield the executor of a cluster."""
    if mpi:
        from mpi4py.futures import MPIPoolExecutor

        with MPIPoolExecutor() as executor:
            yield executor
        return
    from distributed import Client, LocalCluster

    if dask is not None:
        with Client(dask) as client:
            yield client.get_executor()
        return
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        yield client.get_executor()


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dask", metavar="ADDRESS", help="of a Dask scheduler; default: a cluster of two processes here")
    parser.add_argument("--mpi", action="store_true", help="by MPI instead; needs mpi4py")
    parser.add_argument("--draws", type=int, default=200)
    arguments = parser.parse_args()
    library, install = ("mpi4py", "mpi4py") if arguments.mpi else ("distributed", "'pincal[cluster]'")
    if find_spec(library) is None:
        parser.error(f"{library} is not installed: run pip install {install}")

    rng = np.random.default_rng(1)
    machine = draw_typical_errors(TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0"), rng)
    q = plan_poses(machine.nominal, POSES + 20, rng)
    read = Instrument(targets=(0.1, 0.05, 0.15), sigma=NOISE).measure(machine, q, rng=rng)
    table = pincal.measurements_from_arrays(machine.names, q, position=np.column_stack([read[axis] for axis in "xyz"]))
    robot = pincal.Robot.from_urdf(kuka_urdf_path())
    fit = pincal.calibrate(robot, table.select(slice(0, POSES)), pincal.Options(effects=pincal.GEOMETRIC, sigma=NOISE))

    with executor_of(arguments.dask, mpi=arguments.mpi) as executor:
        draws = fit.bootstrap(draws=arguments.draws, executor=executor)
    few = min(4, arguments.draws)
    is_same = np.array_equal(draws[:few], fit.bootstrap(draws=few))
    print(f"{len(draws)} draws; the first {few} as one loop makes them: {is_same}")
    elsewhere = fit.problem.conditions.select(slice(0, 40))
    spread = np.std([fit.model.predict(values, elsewhere)[:, :, 3] for values in draws], axis=0)
    print(f"Standard deviation of predicted coordinates by the bootstrap: {1e3 * np.sqrt(np.mean(spread**2)):.4f} mm")


# Processes that the cluster starts read this file, too, and are not to start clusters of their own.
if __name__ == "__main__":
    main()
