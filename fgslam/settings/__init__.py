"""Settings of the components: frozen, validated, each field with its unit, meaning and source.

They belong to the lowest layer: components take them as plain values, the configuration composes
them into one strict schema.
"""
