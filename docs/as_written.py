"""Have Sphinx show signatures and fields as the source has them."""

import ast
import inspect
import textwrap

from sphinx.pycode import ModuleAnalyzer
from sphinx.util.nodes import make_refnode


def setup(app):
    """Register what follows."""
    app.connect("autodoc-process-signature", write_signature)
    app.connect("autodoc-process-docstring", prepare_docstring, priority=400)  # napoleon's is 500
    app.connect("autodoc-skip-member", skip_field_numbers)
    app.connect("missing-reference", link_last_part)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_signature(app, what, name, obj, options, signature, returns):
    """Return a signature with the names of types, such as `ScalarLike`, and not the six types behind it."""
    if what not in ("class", "function", "method"):
        return None
    definition = ast.parse(textwrap.dedent(inspect.getsource(obj))).body[0]
    for node in ast.walk(definition):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            node.value = node.value.strip()  # the source has " n", which linters do not take for a name
    if isinstance(definition, ast.ClassDef):
        fields = [ast.unparse(line) for line in definition.body if isinstance(line, ast.AnnAssign)]
        return f"({', '.join(fields)})" if fields else "", None
    if not isinstance(definition, ast.FunctionDef):
        return None
    if what == "method":
        del definition.args.args[0]
    returns = definition.returns and ast.unparse(definition.returns).strip("'")
    return f"({ast.unparse(definition.args)})", returns


def prepare_docstring(app, what, name, obj, options, lines):
    """Bring a docstring into the form that napoleon reads, in place."""
    if what == "class":
        # Fields with docstrings of their own, below them, are listed like those that the class lists.
        for (owner, field), docs in ModuleAnalyzer.for_module(obj.__module__).find_attr_docs().items():
            if owner == obj.__qualname__:
                lines += [] if "Attributes:" in lines else ["", "Attributes:"]
                lines.append(f"    {field}: {' '.join(docs).strip()}")
    elif what in ("attribute", "data", "property"):
        # In a first line, what stands before a colon would be taken for the type: begin with a comment.
        lines[:0] = ["..", ""]


def skip_field_numbers(app, what, name, obj, skip, options):
    """Leave out what a NamedTuple says of a field by itself, its number."""
    return skip or type(obj).__name__ == "_tuplegetter"


def link_last_part(app, env, node, contnode):
    """Link the last part of a name, such as `mjx.make_control_step`, to the one thing that ends in it."""
    found = {
        name: entry
        for name, entry in env.domains.python_domain.objects.items()
        if name.endswith("." + node["reftarget"]) and entry.objtype in ("class", "data", "function")
    }
    if node.get("refdomain") != "py" or len(found) != 1:
        return None
    ((name, entry),) = found.items()
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, contnode, name)
