"""Changes to fields of a recording before it is written."""


def put(name, value):
    """Field `name` becomes `value` of it."""

    def change(fields):
        fields[name] = value(fields[name])

    return change


def one(row, value):
    """The entry at `row` becomes `value`."""

    def change(values):
        values[row] = value
        return values

    return change
