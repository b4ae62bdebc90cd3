"""A table of figures, and the checks that failed."""


class Table:
    def __init__(self, title):
        self.title, self.rows, self.failed, self.notes = title, [], [], []

    def row(self, what, figure, wanted="", held=True):
        """Adds a figure. `wanted` is the requirement and `held` whether it is met. A figure without a requirement is for information."""
        self.rows.append((what, str(figure), wanted, "" if held else "<-- FAILED"))
        if not held:
            self.failed.append(what)

    def equal(self, what, figure, wanted):
        self.row(what, figure, str(wanted), figure == wanted)

    def note(self, text):
        """Adds a line below the table."""
        self.notes.append(text)

    def print(self):
        widths = [max([len(row[column]) for row in self.rows] + [0]) for column in range(3)]
        print(f"\n{self.title}")
        for row in self.rows:
            print("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths)) + "  " + row[3])
        for text in self.notes:
            print(f"  {text}")
        print(flush=True)
