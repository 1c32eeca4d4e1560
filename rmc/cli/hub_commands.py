"""What ``rmc hub`` does."""

from rmc.analysis import hub, model_card
from rmc.analysis.out_file import check_writable
from rmc.analysis.policy_file import read_policy
from rmc.cli import hub_options
from rmc.common.checkpoint import POLICY
from rmc.common.whole_file import write_whole
from rmc.deploy.monitor.view import terminal


def run_hub(command: hub_options.Hub) -> int:
    action = command.action
    return _push(action) if isinstance(action, hub_options.Push) else _pull(action)


def _push(action: hub_options.Push) -> int:
    hub.check_hub(action.repo)
    policy = read_policy(action.run, action.checkpoint)
    text = model_card.card(policy.header, action.repo, action.license)
    files = {POLICY: policy.encode(), hub.CARD: text.encode()}
    address = hub.push(action.repo, files, action.private)
    terminal().print(f"{address}: {policy.header.summary()}", soft_wrap=True)
    return 0


def _pull(action: hub_options.Pull) -> int:
    check_writable("--out", action.out, (".safetensors",))
    policy = read_policy(hub.pull(action.repo, action.revision))
    write_whole(action.out, policy.blob)
    terminal().print(f"{action.out}: {policy.header.summary()}", soft_wrap=True)
    return 0
