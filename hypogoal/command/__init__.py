"""How a function becomes a command and a function of Python: calls, the list of stages and tools, signatures."""
