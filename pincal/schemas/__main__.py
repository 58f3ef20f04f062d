"""Write the schemas of pincal's own files into this folder."""

from pincal.atomic import write_atomic
from pincal.schemas import names, shipped, structure_of, text_of

for name in names():
    if structure_of(name).__module__.startswith("pincal."):
        write_atomic(shipped(name), text_of(name))
