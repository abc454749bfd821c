"""Steps of explicit methods: their control, motions alone and in lanes, derivatives."""
