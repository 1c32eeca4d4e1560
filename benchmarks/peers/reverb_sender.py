"""Sends windows to a Reverb server at a set rate, so many seconds for each line of standard input.

python reverb_sender.py PORT O A H LAYOUT RATE CHUNK
"""

import sys

from reverb_table import Writer, columns_of
from turns import send_at, take_turns
from windows import Sizes

if __name__ == "__main__":
    port, observation, action, hidden, layout, rate, chunk = sys.argv[1:]
    sizes = Sizes(int(observation), int(action), int(hidden))
    writer = Writer(int(port), columns_of(sizes, int(chunk), layout))
    take_turns(lambda seconds: send_at(float(rate), int(chunk), seconds, lambda: writer.write(int(chunk))))
