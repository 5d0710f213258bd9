# SPDX-License-Identifier: Apache-2.0
"""Masses and friction of an arm from a table, as a corrected URDF.

python examples/07_identify_csv.py [TABLE.csv ROBOT.urdf TIP]

Without a table it makes one, of a simulated UR5e whose links are up to 30 % heavier or
lighter than its URDF says.
"""

import sys
import tempfile
from pathlib import Path

from blf_dsc_controller.cli.main import main

out = Path(tempfile.mkdtemp())
table, urdf, tip = (*sys.argv[1:4], '', '', '')[:3]
if not table:
    run, table, urdf, tip = out / 'run', str(out / 'run.csv'), 'ur5e.urdf', 'tool0'
    main(['run', '--config', 'ur5e', '--offline', '--duration', '8', '--out', str(run)])
    main(['export', str(run / 'bag'), '--out', table])

# the columns, by patterns: `doc/identify.md` has all rules
columns = ['--map', 'time=time*', '--map', 'q=position *', '--map', 'tau=effort *']
written = ['--out', str(out / 'corrected.urdf'), '--report', str(out / 'page.html')]
code = main(['identify', table, '--urdf', urdf, '--tip', tip, *columns, *written])
print(f'written into {out}')
sys.exit(code)
