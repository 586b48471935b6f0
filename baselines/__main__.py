from baselines.commands.cli import main

main()
