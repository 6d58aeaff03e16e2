"""Columns of numbers of a Parquet file, by pyarrow. Numbers are little-endian, counts u64 and values f64.

`read FILE MOST NAME…` prints the columns of these names (all, if there is none), lists and structures as deep as they
are: the length of the name and the name, how many rows and values there are, how many values each row has, the values.
More than MOST values are refused. `write FILE NAME…` makes a file of columns, whose rows it reads, and then each
column's values; where one is not a number there is none.
"""

import sys

sys.path[:] = filter(None, sys.path)  # what lies in the working folder is not imported

try:
    import numpy as np
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq
except ImportError as error:
    hint = "install them into a virtual environment and name its Python in CAUDATA_PYTHON"
    print("needs a Python with pyarrow and numpy (%s): %s" % (error, hint), file=sys.stderr)
    sys.exit(69)


def numbers(array):
    """How many values each row has, and the values."""
    if pa.types.is_nested(array.type):
        sizes, values = numbers(pc.list_flatten(array))
        ends = np.cumsum(pc.fill_null(pc.list_value_length(array), 0).to_numpy(zero_copy_only=False), dtype=np.int64)
        return np.diff(np.concatenate(([0], np.cumsum(sizes, dtype=np.int64)))[ends], prepend=0), values
    said = array.is_valid().to_numpy(zero_copy_only=False)
    return said.astype(np.int64), pc.cast(pc.drop_null(array), pa.float64(), safe=False).to_numpy(zero_copy_only=False)


def leaves(name, array):
    """The columns of numbers in a column."""
    kind = array.type
    if pa.types.is_struct(kind):
        for part, field in zip(array.flatten(), kind):
            yield from leaves("%s.%s" % (name, field.name), part)
        return
    inside = kind
    while pa.types.is_list(inside) or pa.types.is_large_list(inside) or pa.types.is_fixed_size_list(inside):
        inside = inside.value_type
    if pa.types.is_integer(inside) or pa.types.is_floating(inside) or pa.types.is_boolean(inside):
        yield name, *numbers(array)


def read(path, most, *wanted):
    with pq.ParquetFile(path, memory_map=True) as file:
        names = [name for name in file.schema_arrow.names if not wanted or name in wanted]
        about = file.metadata
        chunks = [about.row_group(g).column(c) for g in range(about.num_row_groups) for c in range(about.num_columns)]
        inside = tuple(name + "." for name in names)
        values = sum(c.num_values for c in chunks if (c.path_in_schema + ".").startswith(inside))
        if values > int(most):
            sys.exit("has more than %s values: split it" % most)
        table = file.read(columns=names)
    for name in names:
        for leaf, sizes, values in leaves(name, table[name].combine_chunks()):
            text = leaf.encode()
            sys.stdout.buffer.write(np.array([len(text)], "<u8").tobytes() + text)
            sys.stdout.buffer.write(np.array([len(sizes), len(values)], "<u8").tobytes())
            sys.stdout.buffer.write(sizes.astype("<u8").tobytes() + values.astype("<f8").tobytes())
    sys.stdout.flush()


def write(path, *names):
    values = np.frombuffer(sys.stdin.buffer.read(), "<f8").reshape(len(names), -1)
    columns = {name: pa.array(column, mask=np.isnan(column)) for name, column in zip(names, values)}
    pq.write_table(pa.table(columns), path, compression="zstd")


try:
    {"read": read, "write": write}[sys.argv[1]](*sys.argv[2:])
except (OSError, pa.ArrowException) as error:
    sys.exit(str(error).splitlines()[0])
