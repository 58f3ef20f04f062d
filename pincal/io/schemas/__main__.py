"""Write the schemas beside this module."""

from pincal.atomic import write_whole
from pincal.io.schemas import FILES, shipped, text_of

for name in FILES:
    write_whole(shipped(name), text_of(name))
