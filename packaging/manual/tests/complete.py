"""Types a line and a tab into an interactive bash that has read a completion script; prints the line as bash
completed it.

usage: complete.py SCRIPT LINE
"""
import os
import pty
import sys

script, line = sys.argv[1:]
child, terminal = pty.fork()
if child == 0:
    os.environ.update(TERM="dumb", PS1="$ ", INPUTRC="/dev/null")
    os.execvp("bash", ["bash", "--noprofile", "--norc", "-i"])

seen = ""


def read_to(mark):
    """Returns what bash prints before a mark."""
    global seen
    while mark not in seen:
        try:
            seen += os.read(terminal, 4096).decode()
        except OSError:
            sys.exit(f"bash ended: {seen!r}")
    before, seen = seen.split(mark, 1)
    return before


def send(text):
    os.write(terminal, text.encode())


# The terminal echoes what is typed, where the marks are in quotes.
send(f"source '{script}'; printf 'REA''DY'\n")
read_to("READY")
# Control-A and a colon make the line harmless. It is read back from the history, for the echo holds bells and
# line breaks.
send(f"{line}\t\x01: \x05\n")
send("printf 'LI''NE'; fc -ln -1 -1; printf 'EN''D'\n")
read_to("LINE")
print(read_to("END").strip().removeprefix(": "))
send("exit\n")
os.waitpid(child, 0)
