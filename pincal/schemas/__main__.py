"""Write the schemas into this folder."""

from pincal.atomic import write_atomic
from pincal.schemas import FILES, shipped, text_of

for name in FILES:
    write_atomic(shipped(name), text_of(name))
