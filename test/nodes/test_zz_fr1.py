import numpy as np, pytest
from processes import PROJECT
from wake_ups import judge, wake_up_on_frames
from scipy.spatial.transform import Rotation
from cliploc_ros.datasets.tum import read_tum
# camera from imu: fitted on all of it
M=np.array([[-0.999,0.025,-0.048],[-0.028,-0.998,0.053],[-0.047,0.054,0.997]])
@pytest.mark.parametrize('gravity',['none','imu'])
def test_fr1(tmp_path,start,tester,gravity):
    start('nodes.detector',fresh=True,parameters={'model':'/work/shared/data/weights/yolov8n_coco.pt'}).wait_for_output('ready after')
    q=Rotation.from_matrix(M.T).as_quat().tolist()
    start('nodes.relocalizer',fresh=True,parameters={'map_file':'/tmp/fr1/map.yaml','matching':'class','gravity':gravity,'base_frame':'imu','base_from_camera':[0.0,0.0,0.0,*q],'cache_dir':tmp_path}).wait_for_output('ready after')
    tester.connect()
    start('cli.replay','/tmp/fr1/bag','--loop','--rate','0.5')
    answers=wake_up_on_frames(tester,66)
    import pickle; pickle.dump([(a.__dict__ if hasattr(a,'__dict__') else a) for a in answers],open(f'/tmp/fr1/{gravity}.pickle','wb')) if False else None
    seq=read_tum('/tmp/fr1/odd')
    from dataclasses import replace
    print(gravity, len(answers)); 
    try: print(judge(answers,seq))
    except Exception as e: print('judge',e, answers[:2])
